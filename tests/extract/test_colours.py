"""What of an object's colours a silhouette leaves out."""

from __future__ import annotations

import numpy as np
from vid2demo.extract.colours import spilled_share

OURS, NOT_OURS = 2.0, -1.0


def scene(columns: slice) -> tuple[np.ndarray, np.ndarray]:
    """Evidence of an object in rows 40 to 79 of some columns, and nothing that hides it."""
    evidence = np.full((120, 300), NOT_OURS, np.float32)
    evidence[40:80, columns] = OURS
    return evidence, np.zeros(evidence.shape, bool)


def silhouette(columns: slice) -> np.ndarray:
    mask = np.zeros((120, 300), bool)
    mask[40:80, columns] = True
    return mask


def test_a_silhouette_that_covers_the_object_leaves_nothing_out() -> None:
    assert spilled_share(silhouette(slice(100, 140)), *scene(slice(100, 140))) == 0.0


def test_what_goes_on_beyond_is_counted_in_silhouettes() -> None:
    share = spilled_share(silhouette(slice(100, 140)), *scene(slice(100, 150)))
    assert np.isclose(share, 9 / 40)  # without the column along the rim, where colours mix


def test_other_things_of_its_colours_do_not_count() -> None:
    evidence, hidden = scene(slice(100, 140))
    evidence[40:80, 145:150] = OURS  # apart from it
    assert spilled_share(silhouette(slice(100, 140)), evidence, hidden) == 0.0


def test_what_is_far_does_not_count_although_it_touches() -> None:
    near = spilled_share(silhouette(slice(100, 140)), *scene(slice(100, 165)))
    assert np.isclose(near, spilled_share(silhouette(slice(100, 140)), *scene(slice(100, 290))))


def test_what_is_hidden_does_not_count() -> None:
    evidence, hidden = scene(slice(100, 150))
    hidden[:, 140:] = True
    assert spilled_share(silhouette(slice(100, 140)), evidence, hidden) == 0.0
