"""How a vessel is turned about its own axis, found from the whole clip at once.

A vessel's body hardly shows its spin; only handle, spout or lip do, and a hand often hides those. Frame by frame the
spin is therefore a guess that drifts. Here every spin is scored in many frames by how well the silhouette covers
what is object-coloured, and dynamic programming picks the spins that explain all frames while turning little between
them (Viterbi, 1967).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .geometry import Array
from .raster import render_depth
from .region import ColourModel, TrackingMesh

SPINS = 48
EVIDENCE_RANGE = (-1.0, 2.0)  # log-odds; skin over a handle must not outvote the frames that show the handle
TURN_COST = 0.03  # of a turn by one step between neighbouring samples, in mean log-odds over the object's area


def object_evidence(bins: NDArray[np.int32], colours: ColourModel) -> NDArray[np.float32]:
    """(H, W) log-odds, by colour alone, that a pixel shows the object."""
    odds = np.log((colours.foreground[-1] + 1e-5) / (colours.background[-1] + 1e-5))
    return np.asarray(np.clip(odds, *EVIDENCE_RANGE)[bins], np.float32)


def spin_scores(
    mesh: TrackingMesh,
    T: Array,
    camera_matrix: Array,
    evidence: NDArray[np.float32],
    axis_xy_m: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """(SPINS,) mean evidence under the silhouette, with the object turned about its upright axis in equal steps.

    All spins are divided by one area, so that covering more of the object's colours counts.
    """
    height, width = evidence.shape
    totals, areas = np.zeros(SPINS), np.zeros(SPINS)
    for k in range(SPINS):
        window = render_depth(mesh.vertices_m, mesh.faces, spun(T, 2 * np.pi * k / SPINS, axis_xy_m), camera_matrix)
        if window is not None:
            silhouette = window.mask_in_image(width, height)
            totals[k], areas[k] = float(evidence[silhouette].sum()), float(np.count_nonzero(silhouette))
    return totals / max(float(areas.mean()), 1.0)


def best_spins(scores: Array, within_rad: float = np.pi) -> Array:
    """(M,) spins in rad, continuous over the M samples, that maximise the summed scores (M, SPINS) less the turning.

    within_rad: no spin is farther than this from none.
    """
    angle_rad = 2 * np.pi * np.minimum(np.arange(SPINS), SPINS - np.arange(SPINS)) / SPINS
    scores = np.where(angle_rad <= within_rad + 1e-9, scores, -np.inf)
    step = np.abs((np.arange(SPINS)[:, None] - np.arange(SPINS)[None] + SPINS // 2) % SPINS - SPINS // 2)
    cost = TURN_COST * np.minimum(step, 6) ** 2
    total, back = scores[0].copy(), np.zeros(scores.shape, int)
    for m in range(1, len(scores)):
        options = total[None, :] - cost
        back[m] = np.argmax(options, axis=1)
        total = scores[m] + np.max(options, axis=1)
    path = [int(np.argmax(total))]
    for m in range(len(scores) - 1, 0, -1):
        path.append(int(back[m][path[-1]]))
    return np.asarray(np.unwrap(2 * np.pi * np.array(path[::-1]) / SPINS))


def spun(T: Array, angle_rad: float, axis_xy_m: tuple[float, float] = (0.0, 0.0)) -> Array:
    """The pose with the object turned about the line through `axis_xy_m` along its own +z.

    A vessel's body stands on this line, not on the centre of its bounding box, which handle and spout shift.
    """
    turned = T.copy()
    turned[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, angle_rad]).as_matrix()
    foot = np.array([*axis_xy_m, 0.0])
    turned[:3, 3] += (T[:3, :3] - turned[:3, :3]) @ foot
    return turned
