"""What is about the paper alone: its worlds, printed numbers, theorems, calibration and critique."""
