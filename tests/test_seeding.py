"""One seed, many streams."""

from __future__ import annotations

import torch

from trackmdp.seeding import derive, generator, preserved_global_rng, seed_global


def test_a_stream_is_fixed_by_seed_and_name() -> None:
    """Golden numbers: a change would silently change every run."""
    assert derive(0) == 3456079177858693020
    assert derive(0, "world", "motion") == 7662330250439153818
    assert derive(7, "world", 3) == 5382820910989353637


def test_no_two_streams_are_alike() -> None:
    names = [
        (),
        ("world",),
        ("world", "motion"),
        ("world", "start"),
        ("evaluation", "motion"),
        ("world", 0),
        ("world", 1),
    ]
    seeds = {derive(seed, *name) for seed in range(50) for name in names}
    assert len(seeds) == 50 * len(names)
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_seed_zero_is_a_seed() -> None:
    first, second = generator(0, "a"), generator(0, "a")
    assert torch.equal(torch.rand(5, generator=first), torch.rand(5, generator=second))
    assert not torch.equal(
        torch.rand(5, generator=generator(0, "a")), torch.rand(5, generator=generator(1, "a"))
    )
    seed_global(0)
    drawn = torch.rand(5)
    torch.rand(3)
    seed_global(0)
    assert torch.equal(torch.rand(5), drawn)


def test_draws_inside_leave_the_global_generator_as_it_was() -> None:
    before = torch.get_rng_state()
    with preserved_global_rng():
        torch.rand(10)
        torch.manual_seed(3)
    assert torch.equal(torch.get_rng_state(), before)
