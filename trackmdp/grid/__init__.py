"""The grid: its size, displacements between cells, and geography."""
