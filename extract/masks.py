"""Where an object is in every frame: silhouettes of the tracked mesh, run-length coded, and masks read from pictures.

`NAME.masks.npz` holds `counts` (M,) uint32, the lengths of runs of equal pixels, row by row, beginning with background
in every frame; `offsets` (N + 1,) int64, where each frame's runs begin in `counts`; and `header`, JSON with
`size_px` [width, height]. A frame out of whose view the object is has an empty mask. Parts that something hides count
as the object's.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .files import atomic_path
from .geometry import Array, scaled_camera
from .region import TrackingMesh
from .segment import Mask
from .track import ObjectTrack, load_npz_with_header

SCHEMA = "vid2demo/object-masks"
SCHEMA_VERSION = 1
MASK_SIDE_PX = 1280
LEAST_PX = 64
MOST_SHARE = 0.9  # of the picture


def read_mask(path: Path, width_px: int, height_px: int) -> Mask:
    """(H, W) mask from a picture file: what is lighter than the middle between its darkest and lightest.

    Raises UserError when it cannot be read, has another size than the video, or is empty or nearly everything.
    """
    if not path.is_file():
        raise UserError(f"--mask {path} does not exist")
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise UserError(f"--mask {path} cannot be read as a picture; give a PNG")
    height, width = picture.shape[:2]
    if (width, height) != (width_px, height_px):
        raise UserError(f"--mask {path} has {width} x {height} px, the video {width_px} x {height_px}; make them equal")
    levels = picture[..., :3].max(axis=-1) if picture.ndim == 3 else picture  # an alpha channel says nothing here
    mask = np.asarray(levels > levels.max() // 2)
    if np.count_nonzero(mask) < LEAST_PX:
        raise UserError(f"--mask {path} is empty; paint the object white on black")
    if np.mean(mask) > MOST_SHARE:
        raise UserError(f"--mask {path} covers {np.mean(mask):.0%} of the picture; paint only the object white")
    return mask


def write_masks(path: Path, track: ObjectTrack, mesh: TrackingMesh) -> None:
    """Write the silhouettes of a tracked mesh, at the size of the video but at most MASK_SIDE_PX."""
    width, height = track.header["image_size_px"]
    scale = min(1.0, MASK_SIDE_PX / max(width, height))
    size = (round(width * scale), round(height * scale))
    camera = scaled_camera(track.camera_matrix, scale)
    runs = [
        _runs(_silhouette(mesh, T, camera, size) if visible else np.zeros((size[1], size[0]), bool))
        for T, visible in zip(track.T_camera_object, track.visible, strict=True)
    ]
    header = {"schema": SCHEMA, "version": SCHEMA_VERSION, "object": track.name, "size_px": list(size)}
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(
            stream,
            counts=np.concatenate(runs),
            offsets=np.cumsum([0, *map(len, runs)], dtype=np.int64),
            header=np.array(json.dumps(header)),
        )


class Masks:
    """Masks of one object, as `write_masks` wrote them; `masks[k]` is the (H, W) mask of frame k."""

    def __init__(self, path: Path) -> None:
        """Raises UserError when the file is missing, damaged or of another kind."""
        arrays, header = load_npz_with_header(path, SCHEMA, SCHEMA_VERSION)
        self._counts, self._offsets = arrays["counts"], arrays["offsets"]
        self.width_px, self.height_px = (int(v) for v in header["size_px"])

    def __len__(self) -> int:
        return len(self._offsets) - 1

    def __getitem__(self, index: int) -> Mask:
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        counts = self._counts[self._offsets[index] : self._offsets[index + 1]]
        flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
        return np.asarray(flat.reshape(self.height_px, self.width_px))


def _silhouette(mesh: TrackingMesh, T: Array, camera_matrix: Array, size: tuple[int, int]) -> Mask:
    window = mesh.drawn(T, camera_matrix)
    return np.zeros((size[1], size[0]), bool) if window is None else window.mask_in_image(*size)


def _runs(mask: Mask) -> NDArray[np.uint32]:
    flat = mask.ravel()
    ends = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    lengths = np.diff(np.concatenate([[0], ends, [len(flat)]]))
    return np.asarray(np.concatenate([[0], lengths]) if flat[0] else lengths, np.uint32)
