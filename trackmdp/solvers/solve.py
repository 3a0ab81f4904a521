"""One verb for every solver: `solve(world)`."""

from __future__ import annotations
