"""Data sets in the format of the BOP benchmark: pictures with the true poses of the objects in them.

Files hold millimetres, everything this module returns is in metres; only names that end in `_mm` hold millimetres.
Two layouts are read, told apart by what is there. Scene by scene: `SPLIT/000048/rgb/000001.png`, beside it `depth`,
`mask`, `mask_visib` and `scene_gt.json`, `scene_gt_info.json`, `scene_camera.json`. Image by image:
`SPLIT/000048_000001.rgb.png`, `.depth.png`, `.gt.json`, `.gt_info.json`, `.camera.json`, `.mask.json`,
`.mask_visib.json`, whose masks are run-length coded. Format: Hodan et al., BOP: Benchmark for 6D Object Pose
Estimation, ECCV 2018, and the toolkit's `docs/bop_datasets_format.md`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from .errors import UserError
from .geometry import Array, angle_between_rad, make_pose, rotation_angle_rad
from .protocols import Image, Mask

M_PER_MM = 1e-3
LAYOUTS = ("scenes", "images")
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_SPLITS = ("test", "val", "train", "train_pbr")
_TARGETS = ("test_targets_bop19.json", "test_targets_bop24.json", "val_targets_bop24.json")


@dataclass(frozen=True, order=True)
class ImageKey:
    """Which picture: `im_id` of the scene `scene_id`."""

    scene_id: int
    im_id: int


@dataclass(frozen=True)
class TrueObject:
    """One object in a picture.

    index: its place in the picture's list, which names its masks. T_camera_object: (4, 4), m.
    visible_fraction: share of its silhouette that nothing hides, None where the data set does not say.
    """

    index: int
    obj_id: int
    T_camera_object: Array
    visible_fraction: float | None = None


@dataclass(frozen=True)
class ModelSymmetry:
    """Turns of a model that look the same: rotations (K, 3, 3) in its frame, the identity among them, and any turn
    about each of the axes (unit vectors).
    """

    rotations: Array = field(default_factory=lambda: np.eye(3)[None])
    axes: tuple[tuple[float, float, float], ...] = ()

    def error_rad(self, R: Array, R_true: Array) -> float:
        """Smallest angle between R (3, 3) and what looks like R_true (3, 3)."""
        if len(self.axes) > 1:  # turns about two axes reach every rotation
            return 0.0
        same = R_true @ self.rotations
        if not self.axes:
            return float(rotation_angle_rad(R, same).min())
        axis = np.asarray(self.axes[0])
        return float(angle_between_rad(R @ axis, same @ axis).min())


@dataclass(frozen=True)
class ModelInfo:
    """What `models_info.json` says of a model: `diameter_m`, the largest distance of two vertices; `extents_m` (3,)."""

    diameter_m: float
    extents_m: tuple[float, float, float]
    symmetry: ModelSymmetry = field(default_factory=ModelSymmetry)


@dataclass(frozen=True)
class Target:
    """What is to be found: `count` instances of object `obj_id` in a picture."""

    image: ImageKey
    obj_id: int
    count: int


@dataclass(frozen=True)
class Dataset:
    """A data set of one layout. Every method raises UserError, naming the file, when that is missing or damaged.

    root: folder with `models` and the split. split: folder below it, such as "test". layout: "scenes" or "images".
    """

    root: Path
    split: str
    layout: str
    _read: dict[Path, Any] = field(default_factory=dict, repr=False, compare=False)

    @cached_property
    def images(self) -> tuple[ImageKey, ...]:
        """All pictures with a camera, in order."""
        if self.layout == "images":
            names = [path.name.split(".")[0] for path in self._folder.glob("*.camera.json")]
            return tuple(sorted(ImageKey(*map(int, name.split("_"))) for name in names))
        found = []
        for folder in self._folder.iterdir():
            if folder.name.isdecimal() and (folder / "scene_camera.json").is_file():
                cameras = self._json(folder / "scene_camera.json")
                found += [ImageKey(int(folder.name), int(im_id)) for im_id in cameras]
        return tuple(sorted(found))

    def rgb(self, image: ImageKey) -> Image:
        """(H, W, 3) uint8 RGB; a grey picture is repeated in the three channels."""
        return np.asarray(cv2.cvtColor(_decoded(self.rgb_path(image), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), np.uint8)

    def rgb_path(self, image: ImageKey) -> Path:
        """The picture's file."""
        path = self._picture(image, "rgb") or self._picture(image, "gray")
        if path is None:
            raise UserError(f"{self._place(image)} has no rgb or gray picture")
        return path

    def depth_m(self, image: ImageKey) -> NDArray[np.float32] | None:
        """(H, W) depth along z in m, 0 where there is none; None when the data set has no depth."""
        path = self._picture(image, "depth")
        if path is None:
            return None
        scale_mm = float(self._entry(image, "camera").get("depth_scale", 1.0))
        return np.asarray(_decoded(path, cv2.IMREAD_UNCHANGED), np.float32) * np.float32(scale_mm * M_PER_MM)

    def camera_matrix(self, image: ImageKey) -> Array:
        """(3, 3) intrinsics in px."""
        return self._numbers(self._entry(image, "camera"), "cam_K", 9, self._place(image)).reshape(3, 3)

    def size_px(self, image: ImageKey) -> tuple[int, int]:
        """(width, height) of the picture, from its file's first bytes."""
        path = self.rgb_path(image)
        try:
            with PIL.Image.open(path) as picture:
                return picture.size
        except OSError as error:
            raise UserError(f"{path} cannot be read as a picture") from error

    def objects(self, image: ImageKey) -> tuple[TrueObject, ...]:
        """The true objects of a picture; none where it is not annotated."""
        entries = self._entry(image, "gt", default=[])
        infos = self._entry(image, "gt_info", default=[{}] * len(entries))
        where = f"{self._place(image)} (gt)"
        if len(infos) != len(entries):
            raise UserError(f"{where} tells of {len(entries)} objects, gt_info of {len(infos)}; make them agree")
        found = []
        for index, (entry, info) in enumerate(zip(entries, infos, strict=True)):
            R = self._numbers(entry, "cam_R_m2c", 9, where).reshape(3, 3)
            t_m = self._numbers(entry, "cam_t_m2c", 3, where) * M_PER_MM
            if "obj_id" not in entry:
                raise UserError(f"{where}: object {index} has no obj_id")
            found.append(TrueObject(index, int(entry["obj_id"]), make_pose(R, t_m), info.get("visib_fract")))
        return tuple(found)

    def mask(self, image: ImageKey, index: int, *, visible: bool = True) -> Mask | None:
        """(H, W) silhouette of a picture's object `index`, the visible part or all of it; None where not stored."""
        kind = "mask_visib" if visible else "mask"
        if self.layout == "images":
            coded = self._entry(image, kind, default={}).get(str(index))
            return None if coded is None else mask_from_rle(coded, f"{self._place(image)} ({kind})")
        folder = self._folder / f"{image.scene_id:06d}" / kind
        path = _first_of(folder / f"{image.im_id:06d}_{index:06d}")
        return None if path is None else np.asarray(_decoded(path, cv2.IMREAD_GRAYSCALE) > 0)

    @cached_property
    def models(self) -> dict[int, ModelInfo]:
        """Object id -> measures of its model."""
        path = self._models_folder / "models_info.json"
        found = {}
        for name, entry in self._json(path).items():
            try:
                x, y, z = (float(entry[f"size_{axis}"]) * M_PER_MM for axis in "xyz")
                found[int(name)] = ModelInfo(float(entry["diameter"]) * M_PER_MM, (x, y, z), _symmetry(entry))
            except (KeyError, TypeError, ValueError) as error:
                raise UserError(f"{path}: model {name} lacks or garbles {error}; give diameter, size_x, ...") from error
        return found

    def mesh(self, obj_id: int) -> Any:
        """The model as a trimesh.Trimesh in m, in the frame that the true poses are of."""
        from .meshes import load_mesh

        path = self._models_folder / f"obj_{obj_id:06d}.ply"
        if not path.is_file():
            raise UserError(f"{path} is missing; the data set's models belong there")
        return load_mesh(path, "mm", max_faces=None)

    @cached_property
    def targets(self) -> tuple[Target, ...]:
        """What is to be found: the targets' file, or without one every true object."""
        for name in _TARGETS:
            if (path := self.root / name).is_file() and name.startswith(self.split.split("_")[0]):
                try:
                    return tuple(
                        Target(ImageKey(int(t["scene_id"]), int(t["im_id"])), int(t["obj_id"]), int(t["inst_count"]))
                        for t in self._json(path)
                    )
                except (KeyError, TypeError, ValueError) as error:
                    raise UserError(
                        f"{path} is not a list of targets ({error}); each needs scene_id, im_id, obj_id, inst_count"
                    ) from error
        counted: dict[tuple[ImageKey, int], int] = {}
        for image in self.images:
            for there in self.objects(image):
                counted[image, there.obj_id] = counted.get((image, there.obj_id), 0) + 1
        return tuple(Target(image, obj_id, count) for (image, obj_id), count in counted.items())

    @property
    def _folder(self) -> Path:
        return self.root / self.split

    @cached_property
    def _models_folder(self) -> Path:
        for name in ("models_eval", "models"):
            if (self.root / name / "models_info.json").is_file():
                return self.root / name
        raise UserError(f"{self.root} has no models/models_info.json; get the data set's models too")

    def _place(self, image: ImageKey) -> str:
        return f"{self._folder}: scene {image.scene_id}, image {image.im_id}"

    def _picture(self, image: ImageKey, kind: str) -> Path | None:
        if self.layout == "images":
            return _first_of(self._folder / f"{image.scene_id:06d}_{image.im_id:06d}.{kind}")
        return _first_of(self._folder / f"{image.scene_id:06d}" / kind / f"{image.im_id:06d}")

    def _entry(self, image: ImageKey, kind: str, default: Any = None) -> Any:
        """What the JSON files say of a picture: kind is "camera", "gt", "gt_info", "mask" or "mask_visib"."""
        if self.layout == "images":
            path = self._folder / f"{image.scene_id:06d}_{image.im_id:06d}.{kind}.json"
            if default is not None and not path.is_file():
                return default
            return self._json(path)
        path = self._folder / f"{image.scene_id:06d}" / f"scene_{kind}.json"
        if default is not None and not path.is_file():
            return default
        entry = self._json(path).get(str(image.im_id), default)
        if entry is None:
            raise UserError(f"{path} says nothing of image {image.im_id}")
        return entry

    def _json(self, path: Path) -> Any:
        if path not in self._read:
            self._read[path] = read_json(path)
        return self._read[path]

    @staticmethod
    def _numbers(entry: Mapping[str, Any], name: str, count: int, where: str) -> Array:
        try:
            value = np.asarray(entry[name], float).ravel()
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{where} lacks or garbles {name} ({error})") from error
        if value.shape != (count,) or not np.all(np.isfinite(value)):
            raise UserError(f"{where}: {name} must be {count} finite numbers")
        return value


def open_dataset(root: Path | str, split: str | None = None) -> Dataset:
    """A data set of either layout. split: folder of the pictures; without it test, val or train, as there is.

    Raises UserError when there is no such folder or no pictures in it.
    """
    root = Path(root)
    if not root.is_dir():
        raise UserError(f"the data set {root} does not exist; name a folder in BOP's format")
    there = [name for name in ((split,) if split else _SPLITS) if (root / name).is_dir()]
    if not there:
        wanted = split or ", ".join(_SPLITS)
        raise UserError(f"the data set {root} has no folder {wanted}; name the folder that holds one, or another split")
    folder = root / there[0]
    layout = "images" if any(folder.glob("*.camera.json")) else "scenes"
    dataset = Dataset(root, there[0], layout)
    if not dataset.images:
        raise UserError(
            f"{folder} holds neither NNNNNN/scene_camera.json nor NNNNNN_NNNNNN.camera.json; unpack it first"
        )
    return dataset


def _symmetry(entry: Mapping[str, Any]) -> ModelSymmetry:
    turns = [np.asarray(T, float).reshape(4, 4)[:3, :3] for T in entry.get("symmetries_discrete", ())]
    axes = [np.asarray(turn["axis"], float) for turn in entry.get("symmetries_continuous", ())]
    units = tuple((float(a[0]), float(a[1]), float(a[2])) for a in (axis / np.linalg.norm(axis) for axis in axes))
    return ModelSymmetry(np.stack([np.eye(3), *turns]), units)


def rle_from_mask(mask: Mask) -> dict[str, Any]:
    """A mask as lengths of runs down its columns, the first of background (COCO's uncompressed coding)."""
    flat = np.asarray(mask, bool).ravel(order="F")
    ends = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    lengths = np.diff(np.concatenate([[0], ends, [len(flat)]]))
    counts = ([0] if len(flat) and flat[0] else []) + [int(n) for n in lengths]
    return {"counts": counts, "size": [int(n) for n in np.shape(mask)]}


def mask_from_rle(coded: Mapping[str, Any], where: str = "the mask") -> Mask:
    """The mask (H, W) that `rle_from_mask` coded, or that COCO's tools did, who pack the lengths into text.

    Raises UserError when the lengths do not fill it.
    """
    counts, size = coded.get("counts"), coded.get("size")
    if isinstance(counts, str):
        counts = _unpacked(counts)
    if not isinstance(counts, Sequence) or not isinstance(size, Sequence) or len(size) != 2:
        raise UserError(f"{where} is not run-length coded as {{counts: [...], size: [height, width]}}")
    height, width = (int(n) for n in size)
    if sum(counts) != height * width or min(counts, default=0) < 0:
        raise UserError(f"{where}: runs of {sum(counts)} pixels do not fill {width} x {height}")
    flat = np.repeat(np.arange(len(counts)) % 2 == 1, np.asarray(counts, np.int64))
    return np.asarray(flat.reshape((height, width), order="F"))


def _unpacked(text: str) -> list[int]:
    """Lengths of runs from COCO's text: groups of five bits, lowest first, each length told by its change."""
    counts: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        value |= (bits & 0x1F) << shift
        shift += 5
        if bits & 0x20:  # more of this number follows
            continue
        if bits & 0x10:  # negative
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        value = shift = 0
    return counts


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises UserError, with the line, when it is missing or damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist") from error
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is not valid JSON: {error}") from error


def _first_of(stem: Path) -> Path | None:
    return next((p for suffix in PICTURES if (p := stem.with_name(stem.name + suffix)).is_file()), None)


def _decoded(path: Path, mode: int) -> NDArray[Any]:
    picture = cv2.imread(str(path), mode)
    if picture is None:
        raise UserError(f"{path} cannot be read as a picture")
    return np.asarray(picture)
