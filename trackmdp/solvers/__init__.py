"""Everything that reads the motion model: planners (one `solve(world)` each), bounds, exact evaluation, estimators."""
