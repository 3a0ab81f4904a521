"""Estimates of the motion, or of gains, from sensed paths; the learners that plan are built on them."""
