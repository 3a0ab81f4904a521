"""Solving and valuing for several targets."""
