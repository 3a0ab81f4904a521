"""What needs the motion model: exact values, bounds, one `solve(world)` per policy, the paper's theorems as facts."""
