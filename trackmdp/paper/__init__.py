"""The paper: its worlds, printed numbers, theorems, calibration and critique."""
