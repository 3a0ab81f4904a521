"""Objects at a prompt and in a notebook: a few lines of text, a table, a picture."""
