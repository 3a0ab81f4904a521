"""Arrays and sparse matrices: their types, entries, checks and files."""
