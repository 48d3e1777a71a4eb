"""How long a unit of a camera's path is, told by things that rest: the background alone leaves that open.

An object of known size is seen at p(t) by the camera, at R(t) p(t) + s c(t) by the first one: where it rests, that
stays the same for the right s only. Every pair of moments votes, as far as the camera moved between them. Pairs between
which the object was turned or moved agree on nothing, and are outvoted by receptacles, and by what is handled before it
is lifted and after it is set down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .geometry import Array
from .track import ObjectTrack

MOMENTS = 150  # of a track, that are compared with each other
ACROSS, ALONG = 0.004, 0.02  # noise of an object's place across and along the line of sight, of its distance
TURN_NOISE_RAD = float(np.deg2rad(4.0))  # of an object's orientation between two moments
SURE = 0.4  # least confidence of a moment
SCALES = np.geomspace(0.05, 20.0, 600)  # m to the unit that are tried
TOLD = 3.0  # standard deviations that the camera must have moved for a pair to tell much
LEAST_SHARE = 0.1  # of a track's pairs that tell anything, that must agree
RIVAL = 0.7  # of the best one's votes, that no scale apart from it may have
APART = 1.3  # ratio from which on a scale is another
MOST_STD = 0.1  # of the scale
BLOCKS = 8  # parts of the clip, that are left out in turn to see how much the scale hangs on each


@dataclass(frozen=True)
class PathScale:
    """m: metres to a unit of the path, std: its standard deviation in the same; share: of the votes of the track that
    agrees most, that agree.  why_not: in words, what forbids to believe it; empty where nothing does.
    """

    m: float
    std: float
    share: float
    why_not: str = ""


@dataclass(frozen=True)
class _Pairs:
    """Pairs of moments: which track, parts of the clip, weights, and the squared miss a + 2 b s + c s^2 in units of
    the noise.
    """

    track: Array
    parts: Array
    weight: Array
    a: Array
    b: Array
    c: Array

    def votes(self, scale: Array) -> Array:
        """(..., M) for each scale: how much every pair agrees, times how much it can tell."""
        s = np.asarray(scale)[..., None]
        miss = np.maximum(self.a + 2 * self.b * s + self.c * s**2, 0.0)
        tells = self.c * s**2 / (self.c * s**2 + TOLD**2)
        return np.asarray(self.weight * tells / (1 + miss / 6.0) ** 2)

    def refined(self, scale: float, of: Array) -> tuple[float, float]:
        """The scale near a guess that pairs with weights `of` (M,) agree on, and its spread if all were independent."""
        for _ in range(20):
            votes = of * self.votes(np.array(scale))
            scale = float(-(votes * self.b).sum() / max((votes * self.c).sum(), 1e-12))
        return scale, float(1 / np.sqrt(max((votes * self.c).sum(), 1e-12)))


def path_scale(tracks: Sequence[ObjectTrack], T_first_camera: Array) -> PathScale:
    """The scale of a camera's path (N, 4, 4) that lets rest what rests.

    tracks: of the objects in the same frames, poses in each frame's camera.
    """
    pairs = _pairs(tracks, T_first_camera)
    if len(pairs.weight) == 0:
        return PathScale(0.0, 0.0, 0.0, "no object was seen surely from two places")
    votes = np.stack([pairs.votes(s).sum() for s in SCALES])
    best = int(np.argmax(votes))
    scale, spread = pairs.refined(float(SCALES[best]), np.ones(len(pairs.weight)))
    agreeing, telling = pairs.votes(np.array(scale)), pairs.weight * (pairs.c * scale**2 > TOLD**2)
    count = int(pairs.track.max()) + 1
    totals = np.bincount(pairs.track.astype(int), telling, count)
    share = float(np.max(np.bincount(pairs.track.astype(int), agreeing, count) / np.maximum(totals, 1.0)))
    left_out = [(pairs.parts != part).all(axis=1) for part in range(BLOCKS)]
    again = np.array([pairs.refined(scale, keep)[0] for keep in left_out if agreeing[keep].sum() > 0])
    jackknife = np.sqrt((len(again) - 1) * np.var(again)) if len(again) > 1 else scale
    # Pairs share their moments: of so many pairs only about as many are independent.
    std = float(np.hypot(jackknife, spread * np.sqrt(np.sqrt(2 * len(pairs.weight)))))
    apart = np.abs(np.log(SCALES / max(scale, 1e-6))) > np.log(APART)
    why_not = ""
    if telling.sum() < 1.0 or share < LEAST_SHARE:
        why_not = "no object rests while the camera moves far enough"
    elif std > MOST_STD * scale:
        why_not = f"what rests tells the scale to {std / scale:.0%} only"
    elif votes[apart].max(initial=0.0) > RIVAL * votes[best]:
        why_not = "objects that rest agree with two different scales"
    return PathScale(scale, std, share, why_not)


def _pairs(tracks: Sequence[ObjectTrack], T_first_camera: Array) -> _Pairs:
    found: list[tuple[Array, ...]] = []
    R, c = T_first_camera[:, :3, :3], T_first_camera[:, :3, 3]
    for number, track in enumerate(tracks):
        sure = track.confidence * track.visible
        usable = np.flatnonzero(sure > SURE)
        if len(usable) < 2:
            continue
        at = np.unique(usable[np.linspace(0, len(usable) - 1, MOMENTS).astype(int)])
        p = track.T_camera_object[at, :3, 3]
        distance = np.linalg.norm(p, axis=1)
        ray = np.einsum("nij,nj->ni", R[at], p) / distance[:, None]
        noise = (distance**2)[:, None, None] * (
            ACROSS**2 * np.eye(3) + (ALONG**2 - ACROSS**2) * ray[:, :, None] * ray[:, None, :]
        )
        first, second = np.triu_indices(len(at), 1)
        seen = ray * distance[:, None]
        apart, moved = seen[second] - seen[first], c[at[second]] - c[at[first]]
        certain = np.linalg.inv(noise[first] + noise[second])
        turned = R[at] @ track.T_camera_object[at, :3, :3]
        angle = track.symmetry.error_rad(turned[first], turned[second])
        weight = sure[at[first]] * sure[at[second]] * np.exp(-0.5 * (angle / TURN_NOISE_RAD) ** 2)
        part = at * BLOCKS // len(track)
        found.append(
            (
                np.full(len(first), number),
                np.column_stack([part[first], part[second]]),
                weight,
                np.einsum("mi,mij,mj->m", apart, certain, apart),
                np.einsum("mi,mij,mj->m", apart, certain, moved),
                np.einsum("mi,mij,mj->m", moved, certain, moved),
            )
        )
    if not found:
        none = np.zeros(0)
        return _Pairs(none, np.zeros((0, 2)), none, none, none, none)
    return _Pairs(*(np.concatenate(column) for column in zip(*found, strict=True)))
