"""Warp kernel that chooses places apart from one another."""

from __future__ import annotations

from rover_rl.native.warp import wp


@wp.kernel
def choose_apart(
    candidates: wp.array2d[wp.vec2],
    allowed: wp.array2d[wp.bool],
    numbers: wp.array[int],
    agents: int,
    spacing: float,
    places: wp.array[wp.vec2],
    chosen: wp.array[int],
):
    """Chooses a place for rows of a group, one after the other; thread ``group``.

    A row with ``numbers[row] >= 0`` has the candidates of that number. It takes the first allowed one that is
    ``spacing`` away from the ``places`` of the rows that have theirs already, or, if there is none, the farthest.
    ``places`` and ``chosen``, the index of the candidate, are set.
    """
    first = wp.tid() * agents
    for row in range(first, first + agents):
        number = numbers[row]
        if number < 0:
            continue
        best = float(-1.0)
        chosen[row] = 0
        for k in range(candidates.shape[1]):
            if allowed[number, k] and best < spacing:
                gap = float(spacing)
                for other in range(first, first + agents):
                    if other < row or numbers[other] < 0:
                        gap = wp.min(gap, wp.length(candidates[number, k] - places[other]))
                if gap > best:
                    best = gap
                    chosen[row] = k
        places[row] = candidates[number, chosen[row]]
