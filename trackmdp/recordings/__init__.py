"""Recorded tracks, and positions that become tracks."""
