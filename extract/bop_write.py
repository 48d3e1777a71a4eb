"""Writing data sets in the format of the BOP benchmark; `extract.bop` reads them. Files hold millimetres."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from .bop import LAYOUTS, M_PER_MM, ModelSymmetry, Target, rle_from_mask
from .errors import UserError
from .files import atomic_path, write_json
from .geometry import Array, make_pose
from .protocols import Image, Mask

DEPTH_SCALE_MM = 0.1  # of one step of a depth picture: 6.5 m at most


@dataclass(frozen=True)
class Instance:
    """One object in a picture that is written.

    T_camera_object: (4, 4), m. mask: (H, W) its whole silhouette. visible: (H, W) what nothing hides of it.
    """

    obj_id: int
    T_camera_object: Array
    mask: Mask
    visible: Mask


@dataclass(frozen=True)
class Frame:
    """One picture with all that is known of it.

    rgb: (H, W, 3) uint8. depth_m: (H, W), along z, 0 where there is none. camera_matrix: (3, 3), px.
    """

    im_id: int
    rgb: Image
    depth_m: NDArray[np.float32]
    camera_matrix: Array
    instances: tuple[Instance, ...]


def write_scene(root: Path, split: str, scene_id: int, frames: Sequence[Frame], layout: str = "scenes") -> None:
    """Write the pictures of one scene, its JSON files last, so that a scene with a camera file is complete.

    Raises UserError for a layout other than "scenes" and "images".
    """
    if layout not in LAYOUTS:
        raise UserError(f"the layout is {layout!r}; choose {' or '.join(LAYOUTS)}")
    folder = root / split
    for frame in frames:
        if layout == "images":
            stem = f"{scene_id:06d}_{frame.im_id:06d}"
            _write_pictures(frame, folder / f"{stem}.rgb.png", folder / f"{stem}.depth.png")
            masks = {str(k): rle_from_mask(i.mask) for k, i in enumerate(frame.instances)}
            write_json(folder / f"{stem}.mask.json", masks)
            visible = {str(k): rle_from_mask(i.visible) for k, i in enumerate(frame.instances)}
            write_json(folder / f"{stem}.mask_visib.json", visible)
            for kind, entry in _entries(frame).items():
                write_json(folder / f"{stem}.{kind}.json", entry)
        else:
            here, name = folder / f"{scene_id:06d}", f"{frame.im_id:06d}"
            _write_pictures(frame, here / "rgb" / f"{name}.png", here / "depth" / f"{name}.png")
            for k, instance in enumerate(frame.instances):
                _write_picture(here / "mask" / f"{name}_{k:06d}.png", instance.mask * np.uint8(255))
                _write_picture(here / "mask_visib" / f"{name}_{k:06d}.png", instance.visible * np.uint8(255))
    if layout == "scenes":
        entries = {str(frame.im_id): _entries(frame) for frame in frames}
        for kind in ("gt", "gt_info", "camera"):
            path = folder / f"{scene_id:06d}" / f"scene_{kind}.json"
            write_json(path, {im_id: entry[kind] for im_id, entry in entries.items()})


def write_models(root: Path, meshes: Mapping[int, Any], symmetries: Mapping[int, ModelSymmetry] | None = None) -> None:
    """Write `models/obj_*.ply` in mm and `models_info.json` of trimesh.Trimesh in m, by object id.

    symmetries: of the models that look the same after a turn about an axis through their origin.
    """
    infos: dict[str, dict[str, Any]] = {}
    for obj_id, mesh in sorted(meshes.items()):
        in_mm = mesh.copy()
        in_mm.apply_scale(1 / M_PER_MM)
        with atomic_path(root / "models" / f"obj_{obj_id:06d}.ply") as temporary:
            in_mm.export(temporary)
        low, size = in_mm.bounds[0], in_mm.extents
        info = {"diameter": diameter(np.asarray(in_mm.vertices))}
        info |= {f"min_{axis}": float(v) for axis, v in zip("xyz", low, strict=True)}
        infos[str(obj_id)] = info | {f"size_{axis}": float(v) for axis, v in zip("xyz", size, strict=True)}
        same = (symmetries or {}).get(obj_id, ModelSymmetry())
        if len(same.rotations) > 1:
            turns = [R for R in same.rotations if not np.allclose(R, np.eye(3))]
            infos[str(obj_id)]["symmetries_discrete"] = [_plain(make_pose(R)) for R in turns]
        if same.axes:
            turns_about = [{"axis": list(axis), "offset": [0.0, 0.0, 0.0]} for axis in same.axes]
            infos[str(obj_id)]["symmetries_continuous"] = turns_about
    write_json(root / "models" / "models_info.json", infos)


def write_targets(root: Path, split: str, targets: Iterable[Target]) -> None:
    """Write the list of what is to be found."""
    listed = [
        {"scene_id": t.image.scene_id, "im_id": t.image.im_id, "obj_id": t.obj_id, "inst_count": t.count}
        for t in targets
    ]
    write_json(root / f"{split}_targets_bop19.json", listed)


def diameter(points: Array) -> float:
    """Largest distance between two of the points (N, 3), in their unit."""
    from scipy.spatial import ConvexHull

    corners = points[ConvexHull(points).vertices]
    return float(max(cdist(block, corners).max() for block in np.array_split(corners, len(corners) // 1000 + 1)))


def box_of(mask: Mask) -> list[int]:
    """[x, y, width, height] in px around the True pixels; [-1, -1, -1, -1], as BOP writes it, when there are none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return [-1] * 4
    return [int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1)]


def _entries(frame: Frame) -> dict[str, Any]:
    camera = {"cam_K": _plain(frame.camera_matrix), "depth_scale": DEPTH_SCALE_MM}
    truths, infos = [], []
    for instance in frame.instances:
        T, whole = instance.T_camera_object, int(np.count_nonzero(instance.mask))
        pose = {"cam_R_m2c": _plain(T[:3, :3]), "cam_t_m2c": _plain(T[:3, 3] / M_PER_MM)}
        truths.append(pose | {"obj_id": instance.obj_id})
        seen = int(np.count_nonzero(instance.visible))
        infos.append(
            {
                "bbox_obj": box_of(instance.mask),
                "bbox_visib": box_of(instance.visible),
                "px_count_all": whole,
                "px_count_valid": int(np.count_nonzero(frame.depth_m[instance.mask] > 0)),
                "px_count_visib": seen,
                "visib_fract": seen / max(whole, 1),
            }
        )
    return {"gt": truths, "gt_info": infos, "camera": camera}


def _write_pictures(frame: Frame, rgb: Path, depth: Path) -> None:
    _write_picture(rgb, cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
    steps = np.rint(frame.depth_m / (DEPTH_SCALE_MM * M_PER_MM))
    # What is too far for 16 bits has no depth, as behind a sensor's range.
    _write_picture(depth, np.where(steps > np.iinfo(np.uint16).max, 0, steps).astype(np.uint16))


def _write_picture(path: Path, picture: NDArray[Any]) -> None:
    with atomic_path(path) as temporary:
        if not cv2.imwrite(str(temporary), picture):
            raise UserError(f"{path} cannot be written")


def _plain(values: Array) -> list[float]:
    return [float(v) for v in np.ravel(values)]
