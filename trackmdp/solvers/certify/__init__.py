"""Proofs of optimality: branch and bound, and the listing of all plans."""
