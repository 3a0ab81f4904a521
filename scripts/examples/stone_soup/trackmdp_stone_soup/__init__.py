"""trackmdp's policies and tracks in Stone Soup (`pip install stonesoup`): one sensor a cell, one manager a policy."""
