"""Sensing: the tracker's task, what each sensor covers and reports, and the best set of a step."""
