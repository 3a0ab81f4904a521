"""Episodes as files: recorded, logged in MCAP, read back, re-simulated, shown."""
