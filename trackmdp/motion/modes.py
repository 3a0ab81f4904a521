"""Targets with a hidden mode: the next move depends on the cell and on a mode, such as a heading, that is not shown.

A hidden state is z = cell · H + mode, H modes in every cell. The tracker sees cells alone: at a detection it knows its
key (`task.memory`), not the state; or the state itself, where a detection reveals the mode (`kernel.reveals`: Doppler,
AIS).

A target first changes its mode, by a table S of its own, then moves by the new mode: Q((x, u), (y, v)) =
S(u, v) P_v(x, y).

Targets that move at a velocity, in metres and seconds, on a grid of cells: constant velocity, coordinated turn.

The models of Bar-Shalom, Li and Kirubarajan (2001): in each step v' = R(ω) v + w, R(ω) a turn by ω, w the noise, and
the target moves by v'. On a grid neither the velocity nor the displacement is rounded, which would lose every speed
under half a cell, but dithered: a number y becomes floor(ξ + y), ξ uniform in [0, 1), with mean y exactly and variance
f (1 - f), f the fractional part of y. A velocity is so brought to the next multiples of the spacing,
and a displacement to whole cells: ξ is then where in its cell the target is, which the grid forgets.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import sparse
from scipy.special import ndtr

from trackmdp.arrays.types import Array, Indices
from trackmdp.config.options import GROUPS
from trackmdp.config.registry import make
from trackmdp.grid.displacements import cell_at, window_offsets
from trackmdp.grid.size import Size, grid_size
from trackmdp.motion.kernel_checks import canonical_kernel, check_kernel

_HEADINGS = np.array([(0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1)])
"""Rows and columns of a step; 0 is to the right, and each of the eight turns left by 45 degrees."""


def turning_back(
    size: Size,
    switch: sparse.csr_array | Array,
    offsets: Indices,
    shares: Array,
    opposite: Indices,
    exit_probability: float,
) -> sparse.csr_array:
    """A target that changes its mode, then takes one of the steps of the new mode; at the border it turns back.

    There it stays in its cell, in the opposite mode. It leaves the grid from anywhere with `exit_probability`.

    Args:
        size: of the grid.
        switch: `[H, H]` probability of each next mode.
        offsets: `[H, K, 2]` rows and columns of the K steps of each mode.
        shares: `[H, K]` probability of each.
        opposite: `[H]`, the mode after turning back.
        exit_probability: of each step.

    Returns:
        `[M · H, M · H]` on z = cell · H + mode.
    """
    (rows, columns), modes = grid_size(size), len(offsets)
    table = sparse.coo_array(switch)
    # [E] changes of mode; [E, K] steps after them; and with a cell before them [M, E, K] ends.
    before, mode, cell = table.row, table.col, np.arange(rows * columns)[:, None, None]
    row, column = cell // columns + offsets[mode, :, 0], cell % columns + offsets[mode, :, 1]
    ahead, free = cell_at((rows, columns), row, column)
    end = np.where(free, ahead * modes + mode[:, None], cell * modes + opposite[mode][:, None])
    weight = ((1.0 - exit_probability) * table.data)[:, None] * shares[mode]
    begin = cell * modes + before[:, None]
    begin, weight = (np.broadcast_to(each, end.shape).ravel() for each in (begin, weight))
    some, states = weight > 0, rows * columns * modes
    return sparse.csr_array(
        (weight[some], (begin[some], end.ravel()[some])), shape=(states, states)
    )


def heading_kernel(
    size: Size, *, keep: float, go: float, exit_probability: float
) -> tuple[sparse.csr_array, int]:
    """Eight headings: kept with `keep`, else turned by 45 degrees to either side; then a step that way with `go`.

    At the border the target turns back: it stays in its cell, with the opposite heading. It leaves the grid from
    anywhere with `exit_probability`.

    Returns:
        The kernel on (cell, heading), and 8.
    """
    modes = np.arange(len(_HEADINGS))
    turn = (modes - modes[:, None]) % 8  # from one heading to another, in eighths
    switch = np.select([turn == 0, (turn == 1) | (turn == 7)], [keep, (1.0 - keep) / 2], 0.0)
    offsets = np.stack([_HEADINGS, np.zeros_like(_HEADINGS)], axis=1)
    shares = np.tile([go, 1.0 - go], (8, 1))
    return turning_back(size, switch, offsets, shares, (modes + 4) % 8, exit_probability), 8


def regimes(
    size: Size, *, stay: float | list[float], regimes: list[dict[str, Any]]
) -> tuple[sparse.csr_array, int]:
    """The regime is kept with `stay`, else any other is as likely; then the target moves by the new one's kernel.

    Args:
        size: of the grid.
        stay: one number, or one per regime.
        regimes: of each the kernel's name under `kernel`, and all its options.

    Returns:
        The kernel on (cell, regime), and how many regimes there are.

    Raises:
        UserError: a table is no kernel for this grid.
    """
    kernels = [
        _regime(size, f"kernel.regimes[{place}]", entry) for place, entry in enumerate(regimes)
    ]
    count = len(kernels)
    kept = np.broadcast_to(np.asarray(stay, np.float64), (count,))
    return switching(
        kernels, np.where(np.eye(count) > 0, kept[:, None], (1.0 - kept[:, None]) / (count - 1))
    ), count


def switching(kernels: list[sparse.csr_array], switch: Array) -> sparse.csr_array:
    """`[M · H, M · H]` on z = cell · H + mode, of H kernels `[M, M]` and the probability of each next mode `[H, H]`.

    Q((x, u), (y, v)) = S(u, v) P_v(x, y): the Kronecker product of P_v and of S with its column v alone, for each v.
    """
    columns = np.eye(len(kernels))
    parts = [
        sparse.kron(kernel, sparse.csr_array(switch * own))
        for kernel, own in zip(kernels, columns, strict=True)
    ]
    return sparse.csr_array(sum(parts[1:], parts[0]))


def _regime(size: Size, source: str, entry: dict[str, Any]) -> sparse.csr_array:
    """The kernel `[M, M]` of a regime."""
    options = {name: value for name, value in entry.items() if name != "kernel"}
    more = {"source": f"{source}.path"} if entry["kernel"] == "table" else {}
    made = make(GROUPS["kernel"][entry["kernel"]](**options), size, **more)
    kernel = canonical_kernel(made, source)
    # One regime may have no exit as long as another one has.
    check_kernel(kernel, grid_size(size), truncates=True, source=source)
    return kernel


_TAIL = 4.0
"""Standard deviations at which the noise ends, on either side: 6e-5 of a normal law, and its mean stays exact."""


def constant_velocity(size: Size, **motion: float) -> tuple[sparse.csr_array, int]:
    """Nearly constant velocity: v' = v + w.

    Args:
        size: of the grid.
        motion: `cell`, its side, m; `step`, its time, s; `speed`, the greatest along rows and along columns, m/s
            (faster targets are held to it); `spacing` of the velocities, along either, m/s; `noise`,
            standard deviation of the acceleration along either, m/s², the same for the whole step; `exit_probability`
            of leaving the grid, from anywhere.

    Returns:
        The kernel on (cell, velocity), and the number of velocities: (2 L + 1)², L = floor(speed / spacing).
    """
    return _turning(size, np.zeros(1), np.ones((1, 1)), **motion)


def coordinated_turn(
    size: Size, *, turn_rate: float, stay: float, **motion: float
) -> tuple[sparse.csr_array, int]:
    """A turn by ω in {-ω0, 0, ω0} in each step: v' = R(ω) v + w.

    Args:
        size: of the grid.
        turn_rate: ω0 in degrees/s.
        stay: probability that ω stays the same; else each of the other two is as likely.
        motion: see `constant_velocity`.

    Returns:
        The kernel on (cell, mode), mode = 3 · velocity + turn, and the number of modes.
    """
    change = np.where(np.eye(3) > 0, stay, (1.0 - stay) / 2)
    return _turning(size, turn_rate * np.array([-1.0, 0.0, 1.0]), change, **motion)


def _turning(
    size: Size,
    rates: Array,
    change: Array,
    *,
    cell: float,
    step: float,
    speed: float,
    spacing: float,
    noise: float,
    exit_probability: float,
) -> tuple[sparse.csr_array, int]:
    """The kernel of turns at `rates` `[T]`, degrees/s, with the probability `change` `[T, T]` of each next one."""
    most = math.floor(speed / spacing * (1 + 1e-12))
    # [V, 2] m/s along rows (downwards) and columns, in order
    velocity = spacing * window_offsets(most).astype(np.float64)
    turns = len(rates)
    switch = np.zeros((len(velocity), turns, len(velocity), turns))
    for turn, rate in enumerate(rates.tolist()):
        sine, cosine = math.sin(math.radians(rate * step)), math.cos(math.radians(rate * step))
        turned = velocity @ np.array([[cosine, sine], [-sine, cosine]])
        # The new turn first, from whichever it was, then the velocity that it leads to.
        switch[..., turn] = (
            change[:, turn, None] * _changes(turned, velocity, spacing, noise * step)[:, None]
        )
    modes = turns * len(velocity)
    offsets, shares = steps_of(velocity.repeat(turns, axis=0) * step / cell)
    # Velocities are listed symmetrically about 0, so that the opposite of the k-th is the k-th from the end. Turning
    # back keeps the turn.
    opposite = (np.arange(len(velocity))[::-1, None] * turns + np.arange(turns)).ravel()
    return turning_back(
        size, switch.reshape(modes, modes), offsets, shares, opposite, exit_probability
    ), modes


def dithered(mean: Array, deviation: float, reach: int) -> Array:
    """`[..., 2 reach + 1]` probability of each whole number from -reach to reach for floor(ξ + mean + w).

    ξ is uniform in [0, 1), w normal with `deviation`, cut off at 4 of them. The mean is exact; the variance is w's plus
    the mean of f (1 - f) over w. Numbers beyond `reach` count as `reach`.
    """
    whole = np.arange(-reach, reach + 1) - mean[..., None]
    # floor(ξ + y) <= k has the probability (k + 1 - y)_+ - (k - y)_+: 1 up to y = k, then falling to 0 at k + 1.
    # Averaged over y = mean + w that is F(k + 1 - mean) - F(k - mean), F(t) = E (t - w)_+.
    most = _expected_excess(whole + 1, deviation) - _expected_excess(whole, deviation)
    most[..., -1] = 1.0
    chance: Array = np.diff(most, axis=-1, prepend=0.0)
    return np.where(chance < 1e-12, 0.0, chance)  # rounding


def steps_of(displacement: Array) -> tuple[Indices, Array]:
    """`[H, 4, 2]` whole rows and columns, and `[H, 4]` their probabilities, of mean `displacement` `[H, 2]` cells."""
    low = np.floor(displacement)
    part = displacement - low
    up = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    chance = np.where(up > 0, part[:, None], 1.0 - part[:, None])
    return (low[:, None] + up).astype(np.int64), chance.prod(axis=-1)


def _changes(mean: Array, velocity: Array, spacing: float, deviation: float) -> Array:
    """`[B, V]` probability of each `velocity` `[V, 2]` where the next one is `mean` `[B, 2]` and noise."""
    most = round(float(velocity.max()) / spacing)
    along = dithered(mean / spacing, deviation / spacing, most)  # [B, 2, 2 most + 1]
    # Rows and columns are independent; velocities are numbered by row first.
    chance: Array = along[:, 0, :, None] * along[:, 1, None]
    return chance.reshape(len(mean), -1)


def _expected_excess(t: Array, deviation: float) -> Array:
    """E max(t - w, 0), w normal with mean 0, cut off at `_TAIL` standard deviations."""
    if deviation < 1e-9:  # of a spacing: no noise, and t / deviation may overflow
        return np.maximum(t, 0.0)
    # Over |w| <= a: (t (Φ(t) - Φ(-a)) + φ(t) - φ(a)) / (Φ(a) - Φ(-a)) in units of the deviation; beyond t = a it is t.
    scaled = np.clip(t / deviation, -_TAIL, _TAIL)
    density = (np.exp(-0.5 * scaled**2) - math.exp(-0.5 * _TAIL**2)) / math.sqrt(2.0 * math.pi)
    inside = (scaled * (ndtr(scaled) - ndtr(-_TAIL)) + density) / (ndtr(_TAIL) - ndtr(-_TAIL))
    return deviation * inside + np.maximum(t - _TAIL * deviation, 0.0)
