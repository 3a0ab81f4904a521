"""Worlds: a task with the motion of its targets, from options, from files, one or several at once."""
