"""Depth pictures beside a video: one for every frame, aligned to the colour picture, read when they are asked for.

A folder of 16-bit PNGs, taken in the order of their names, or one array (N, H, W) in an `.npy` file, which is mapped
and not read. Values times the scale are mm along the camera's z, as in BOP's data sets; 0 is no reading.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .geometry import Array, scaled_camera
from .video import VideoInfo

M_PER_MM = 1e-3
NEAREST_M, FARTHEST_M = 0.05, 100.0  # medians of a picture that no scene and no sensor has
LOOKED_AT = 5  # pictures, before anything is done with them
SAME_SHAPE = 0.01  # of the sides' ratio, by which a depth picture may differ from the video


@dataclass(frozen=True)
class DepthView:
    """One depth picture: steps (H, W) along the camera's z, step_m long, 0 or not finite where nothing was read.

    camera_matrix: (3, 3) of the picture.
    """

    steps: NDArray[Any]
    camera_matrix: Array
    step_m: float = 1.0

    @property
    def metres(self) -> NDArray[np.float32]:
        """(H, W) depth in m, 0 where nothing was read."""
        return np.asarray(self._metres(self.steps), np.float32)

    def _metres(self, steps: NDArray[Any]) -> Array:
        metres = steps.astype(float) * self.step_m
        return np.where(np.isfinite(metres) & (metres > 0), metres, 0.0)

    def at(self, pixel: Array) -> Array:
        """(N,) m at pixels (N, 2), 0 where nothing was read and outside of the picture."""
        height, width = self.steps.shape
        with np.errstate(invalid="ignore"):
            x, y = np.round(np.clip(np.nan_to_num(pixel, nan=-9.0), -9, 1e6)).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        return np.where(inside, self._metres(self.steps[y * inside, x * inside]), 0.0)


@dataclass(frozen=True)
class DepthVideo:
    """Depth pictures of a clip, opened but not read.

    path: as the user gave it.  scale_mm: of one step.  size_px: width and height of the pictures.
    """

    path: Path
    scale_mm: float
    size_px: tuple[int, int]
    _files: Sequence[Path] = field(default=(), repr=False)
    _stack: NDArray[Any] | None = field(default=None, repr=False)

    @staticmethod
    def open(path: Path, info: VideoInfo, scale_mm: float = 1.0) -> DepthVideo:
        """The depth pictures of a video.

        Pictures of another size than the video are taken to show the same view, larger or smaller.
        Raises UserError when they cannot be read, are of another number or shape than the video's frames, hold no
        reading, or are so near or far that the scale must be wrong.
        """
        if not (np.isfinite(scale_mm) and scale_mm > 0):
            raise UserError(
                f"--depth-scale {scale_mm:g} is no length; give mm for one step of a depth picture, such as 1"
            )
        files, stack = _opened(path)
        count = len(files) if stack is None else len(stack)
        if count != info.frame_count:
            raise UserError(
                f"--depth {path} holds {count} pictures, {info.path} {info.frame_count} frames; give one for each frame"
            )
        first = _steps(path, files, stack, 0)
        height, width = first.shape
        if abs(width * info.height_px / (height * info.width_px) - 1) > SAME_SHAPE:
            raise UserError(
                f"--depth {path} has pictures of {width} x {height} px, the video {info.width_px} x {info.height_px}; "
                "give depth that is aligned to the colour pictures and shows all of them"
            )
        opened = DepthVideo(path, float(scale_mm), (width, height), files, stack)
        opened._check(count)
        return opened

    def view(self, index: int, camera_matrix: Array, size_px: tuple[int, int]) -> DepthView:
        """The depth of frame `index`. camera_matrix: (3, 3) of colour pictures `size_px` wide and high."""
        steps = _steps(self.path, self._files, self._stack, index)
        width, height = self.size_px
        if steps.shape != (height, width):
            raise UserError(
                f"--depth {self.path}: picture {index} has {steps.shape[1]} x {steps.shape[0]} px, the first {width} x "
                f"{height}; make them equal"
            )
        camera = scaled_camera(camera_matrix, width / size_px[0], height / size_px[1])
        return DepthView(steps, camera, self.scale_mm * M_PER_MM)

    def described(self, sizes: bool) -> dict[str, Any]:
        """For the track's header. sizes: whether the object's size was read off the depth."""
        return {"file": self.path.name, "scale_mm": self.scale_mm, "size_source": "depth" if sizes else "mesh"}

    def _check(self, count: int) -> None:
        """Raise UserError where no picture looked at holds a reading, or readings are at impossible distances."""
        wanted = np.unique(np.linspace(0, count - 1, LOOKED_AT).round().astype(int))
        read = [metres[metres > 0] for k in wanted for metres in [self.view(int(k), np.eye(3), self.size_px).metres]]
        seen = np.concatenate(read)
        if len(seen) == 0:
            raise UserError(f"--depth {self.path} holds no reading: {len(wanted)} of its pictures are zero everywhere")
        middle_m = float(np.median(seen))
        if not NEAREST_M <= middle_m <= FARTHEST_M:
            raise UserError(
                f"--depth {self.path} is {middle_m:.3g} m away in the middle, with {self.scale_mm:g} mm a step; "
                "give --depth-scale MM, such as 1 for mm and 1000 for m"
            )


def _opened(path: Path) -> tuple[list[Path], NDArray[Any] | None]:
    """The files of a folder in the order of their names, numbers by value; or the array of a file."""
    if path.is_dir():
        files = [file for file in path.glob("[!.]*") if file.suffix.lower() == ".png"]
        if not files:
            raise UserError(f"--depth {path} holds no PNG; give a folder of 16-bit pictures, one for each frame")
        return sorted(
            files, key=lambda file: [int(s) if s.isdigit() else s for s in re.split(r"(\d+)", file.name)]
        ), None
    if not path.is_file():
        raise UserError(f"--depth {path} does not exist")
    try:
        stack = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"--depth {path} is neither a folder of PNGs nor an array in an .npy file ({error})") from error
    if not isinstance(stack, np.ndarray) or stack.ndim != 3 or stack.dtype.kind not in "uif" or 0 in stack.shape:
        held = f"{stack.dtype} {stack.shape}" if isinstance(stack, np.ndarray) else "several arrays"
        raise UserError(f"--depth {path} holds {held}; give numbers in an .npy file, (frames, height, width)")
    return [], stack


def _steps(path: Path, files: Sequence[Path], stack: NDArray[Any] | None, index: int) -> NDArray[Any]:
    """(H, W) of one picture, as it is in the file."""
    if stack is not None:
        return np.asarray(stack[index])
    picture = cv2.imread(str(files[index]), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise UserError(f"--depth {files[index]} cannot be read as a picture; copy it again")
    if picture.dtype != np.uint16 or picture.ndim != 2:
        channels = 1 if picture.ndim == 2 else picture.shape[2]
        raise UserError(
            f"--depth {files[index]} has {channels} x {8 * picture.dtype.itemsize} bits a pixel; give 16-bit grey PNGs"
        )
    return np.asarray(picture)
