"""Which stretches of a broken trajectory belong together.

A stretch ends at a break, or where the camera was lost. Behind a loss it was found again at a place
that it had seen, perhaps long before, and edges lead there. So a stretch can belong to one before
the last break, and not to the one before the loss.
"""

from collections.abc import Collection, Iterable, Sequence

Span = tuple[int, int]  # first and last frame


def pieces(
    frames: Sequence[int],  # of the keyframes
    segments: Sequence[Span],  # between the breaks
    losses: Collection[int],  # keyframes before which the camera was lost
    edges: Iterable[tuple[int, int]],  # between keyframes
) -> list[list[Span]]:
    """Return the groups of stretches that edges tie; those right across a break do not count."""
    stretches: list[Span] = []
    segment_of: list[int] = []  # by stretch
    stretch_of: dict[int, int] = {}  # by keyframe
    for number, (first, last) in enumerate(segments):
        inside = [k for k, frame in enumerate(frames) if first <= frame <= last]
        for k in inside:
            if k == inside[0] or k in losses:
                if k != inside[0]:
                    stretches[-1] = stretches[-1][0], frames[k] - 1
                stretches.append((frames[k], last))
                segment_of.append(number)
            stretch_of[k] = len(stretches) - 1
    group = list(range(len(stretches)))
    for ends in edges:
        a, b = (stretch_of.get(end) for end in ends)
        if a is None or b is None:
            continue
        if abs(a - b) > 1 or segment_of[a] == segment_of[b]:
            group = [group[a] if one == group[b] else one for one in group]
    tied = {one: [s for s, g in zip(stretches, group, strict=True) if g == one] for one in group}
    return list(tied.values())
