"""`vid2demo pose`: from a picture file and what a person says of it to poses on disk."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .choose import Level, choose
from .classical_segment import ClassicalSegmenter
from .errors import UserError
from .features import features_of
from .geometry import Array, focal_prior_camera_matrix
from .image_pose import ImagePoser, PoseSettings
from .masks import read_mask
from .mesh_store import MeshStore
from .model_folder import models_folder
from .neural_segment import FOR_IMAGES, large_enough
from .pose_output import write_poses
from .protocols import Box, DepthEstimator, Image, Proposal, Segmenter, TextImageEncoder
from .scale import SizeReader
from .segment import check_box, mask_box


@dataclass(frozen=True)
class PictureSettings:
    """What a person says of a picture; see the options of `vid2demo pose`."""

    image: Path
    boxes_xywh_px: tuple[Box, ...] = ()
    masks: tuple[Path, ...] = ()
    camera: Box | None = None
    text: str | None = None
    prompt: str = "objects."
    meshes: int = 1
    level: Level = "auto"
    models_dir: Path | None = None


def pose_picture(settings: PictureSettings, store: MeshStore, out: Path) -> dict[str, Any]:
    """Pose every object of a picture and write the files; returns what poses.json holds.

    Raises UserError for a picture, box or mask that cannot be used, and when no object is found.
    """
    rgb = read_picture(settings.image)
    height, width = rgb.shape[:2]
    camera_matrix = _camera_matrix(settings.camera, width, height)
    options = {"models_dir": str(settings.models_dir)} if settings.models_dir else {}
    features = features_of(store.encoder, options)
    kind: dict[str, Any] = {"level": settings.level, "models_dir": settings.models_dir}
    depth = choose("depth", lambda: None, **kind)
    words = choose("words", _no_words, **kind)
    chosen = PoseSettings(meshes=max(settings.meshes, 1))
    poser = ImagePoser(store, features, chosen, depth=_estimator(depth.made), words=_reader(words.made, settings))
    start = time.perf_counter()
    proposals, line = _proposals(rgb, settings, kind)
    poses = poser.pose(rgb, proposals, camera_matrix, text=settings.text)
    seconds = time.perf_counter() - start
    size = f"{depth.line()}, {words.line()}"
    header = {"image": str(settings.image), "database": str(store.root), "encoder": store.encoder}
    return write_poses(out, rgb, camera_matrix, poser, poses, seconds, {**header, "segmenter": line, "size": size})


def read_picture(path: Path) -> Image:
    """(H, W, 3) RGB of a picture file. Raises UserError when it cannot be read."""
    if not path.is_file():
        raise UserError(f"the picture {path} does not exist")
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise UserError(f"{path} cannot be read as a picture; give a PNG or JPEG (a video goes to `vid2demo extract`)")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)


def _camera_matrix(camera: Box | None, width: int, height: int) -> Array:
    if camera is None:
        return focal_prior_camera_matrix(width, height)
    fx, fy, cx, cy = camera
    if not (np.isfinite(camera).all() and fx > 0 and fy > 0):
        raise UserError(f"--camera {fx:g} {fy:g} {cx:g} {cy:g} is no camera; give FX FY CX CY in px, the first two > 0")
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _no_words() -> TextImageEncoder | None:
    """Without a network no picture is read: the retrieved meshes tell their sizes."""
    return None


def _reader(encoder: TextImageEncoder | None, settings: PictureSettings) -> SizeReader | None:
    return None if encoder is None else SizeReader(encoder, cache=models_folder(settings.models_dir))


def _estimator(made: DepthEstimator | None) -> DepthEstimator | None:
    return made


def _proposals(rgb: Image, settings: PictureSettings, kind: dict[str, Any]) -> tuple[list[Proposal], str]:
    """Objects by hand where any were given, else found."""
    height, width = rgb.shape[:2]
    by_hand: list[Proposal] = []
    for path in settings.masks:
        mask = read_mask(path, width, height)
        by_hand.append(Proposal(mask, mask_box(mask), 1.0))
    if settings.masks and not settings.boxes_xywh_px:
        return by_hand, "segmenter: masks by hand"
    chosen = choose("segmenter", _classical, **kind)
    if settings.boxes_xywh_px:
        boxes = [check_box(box, width, height) for box in settings.boxes_xywh_px]
        by_hand += _cut(chosen.made, rgb, boxes)
        return by_hand, f"boxes by hand, {chosen.line()}"
    found = [p for p in chosen.made.propose(rgb, settings.prompt) if large_enough(p.mask, FOR_IMAGES)]
    if not found:
        raise UserError(f"no object was found in {settings.image}; point at one with --box X Y W H")
    return found, chosen.line()


def _classical() -> Segmenter:
    return ClassicalSegmenter()


def _cut(segmenter: Segmenter, rgb: Image, boxes: Sequence[Box]) -> list[Proposal]:
    masks = segmenter.segment(rgb, boxes)
    for mask, box in zip(masks, boxes, strict=True):
        if not mask.any():
            raise UserError(f"nothing stands out in the box {' '.join(f'{v:g}' for v in box)}; give a --mask instead")
    return [Proposal(mask, box, 1.0) for mask, box in zip(masks, boxes, strict=True)]
