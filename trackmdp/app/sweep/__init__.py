"""Many runs from one line: planned, launched, skipped where finished, resumed where interrupted."""
