"""Many runs from one line: planned, launched, skipped where finished, gone on with where cut."""
