"""One track against the truth: files read, frames matched, all metrics in one report."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .geometry import Array, Symmetry
from .metrics import PROTOCOLS, PoseErrors, VelocityErrors, pose_errors, velocity_errors
from .track import ObjectTrack

_TRUTH_ARRAYS = ("T_camera_object", "camera_matrix", "time_s")
MODEL_POINTS = 1000


@dataclass(frozen=True)
class Comparison:
    """frames: compared ones; velocity: the paper's errors by protocol; pose: errors of single poses.

    first_camera: the same of poses in the first frame's camera, the errors of the camera's motion among them; None
        where the truth does not tell how its camera moved.
    """

    frames: int
    visible_frames: int
    velocity: dict[str, VelocityErrors]
    pose: PoseErrors
    first_camera: PoseErrors | None = None

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> Comparison:
        velocity = {name: VelocityErrors(**errors) for name, errors in value["velocity"].items()}
        first = value.get("first_camera")
        return Comparison(
            value["frames"],
            value["visible_frames"],
            velocity,
            PoseErrors(**value["pose"]),
            None if first is None else PoseErrors(**first),
        )

    def table(self) -> str:
        """The same for a reader."""
        lines = [f"{self.frames} frames compared, {self.visible_frames} of them tracked as visible", ""]
        lines.append(
            f"{'protocol':<10}{'e_rot':>10}{'e_proj':>10}{'e_depth':>10}   (deg, % of diagonal, sizes; a frame)"
        )
        for name, errors in self.velocity.items():
            lines.append(f"{name:<10}{errors.e_rot:>10.4f}{errors.e_proj:>10.4f}{errors.e_depth:>10.4f}")
        lines += ["", *_figures(self.pose)]
        if self.first_camera is not None:
            lines += ["", "in the first frame's camera:", *_figures(self.first_camera)]
        return "\n".join(lines)


def _figures(errors: PoseErrors) -> list[str]:
    return [f"{name:<22}{value:>10.4g}" for name, value in errors.to_json().items() if value is not None]


@dataclass(frozen=True)
class Truth:
    """Poses (N, 4, 4), camera (3, 3) px and times (N,) s; where its camera was, and what a track's header adds."""

    T_camera_object: Array
    camera_matrix: Array
    time_s: Array
    symmetry: Symmetry | None = None
    extent_m: float | None = None
    mesh_sha256: str | None = None
    T_first_camera: Array | None = None


def load_truth(path: Path) -> Truth:
    """Truth from an `*.track.npz`, or from a plain npz with T_camera_object, camera_matrix and time_s.

    Of a moving camera a plain npz may hold T_first_camera (N, 4, 4) as well.

    Raises UserError when the file is missing, damaged, or lacks one of them.
    """
    if not Path(path).is_file():
        raise UserError(f"{path} does not exist")
    try:
        with np.load(path, allow_pickle=False) as archive:
            names = set(archive.files)
            arrays = {
                name: np.asarray(archive[name], np.float64)
                for name in (*_TRUTH_ARRAYS, "T_first_camera")
                if name in names
            }
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        # What NumPy says of such files is how to load them unsafely.
        raise UserError(f"{path} cannot be read as a truth: damaged or no npz; give a track or a plain npz") from error
    if missing := [name for name in _TRUTH_ARRAYS if name not in arrays]:
        raise UserError(
            f"{path} lacks {', '.join(missing)}; a truth is a track or an npz with {', '.join(_TRUTH_ARRAYS)}"
        )
    if "header" in names:
        track = ObjectTrack.load(path)
        mesh = track.header.get("mesh", {})
        extents = mesh.get("extents_m")
        return Truth(
            track.T_camera_object,
            track.camera_matrix,
            track.time_s,
            track.symmetry if "symmetry" in mesh else None,
            float(max(extents)) if extents else None,
            mesh.get("sha256"),
            track.T_first_camera,
        )
    T, camera, time_s = (arrays.pop(name) for name in _TRUTH_ARRAYS)
    T_first_camera = arrays.get("T_first_camera")
    if T.shape != (len(time_s), 4, 4) or camera.shape != (3, 3):
        raise UserError(f"{path} has poses {T.shape}, times {time_s.shape} and camera {camera.shape}; they do not fit")
    if T_first_camera is not None and T_first_camera.shape != T.shape:
        raise UserError(f"{path} has poses {T.shape} and T_first_camera {T_first_camera.shape}; they do not fit")
    if not all(np.all(np.isfinite(array)) for array in (T, camera, time_s, *arrays.values())):
        raise UserError(f"{path} holds values that are not finite; write the truth again")
    return Truth(T, camera, time_s, T_first_camera=T_first_camera)


def matched_frames(estimate_s: Array, truth_s: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices into both of the frames that belong together.

    As many frames on both sides are the same frames: recordings are often stored at a nominal rate. Otherwise the
    nearest in time, within half a frame. Raises UserError when there are none.
    """
    if len(estimate_s) == len(truth_s):
        index = np.arange(len(truth_s))
        return index, index
    nearest = np.clip(np.searchsorted(truth_s, estimate_s), 1, max(len(truth_s) - 1, 1))
    if len(truth_s) > 1:
        nearest -= (estimate_s - truth_s[nearest - 1]) < (truth_s[nearest] - estimate_s)
    else:
        nearest[:] = 0
    half_s = 0.5 * float(np.median(np.diff(estimate_s))) if len(estimate_s) > 1 else 0.02
    fits = np.flatnonzero(np.abs(truth_s[nearest] - estimate_s) <= half_s + 1e-6)
    if len(fits) == 0:
        raise UserError(
            f"no frame of the estimate ({estimate_s[0]:.2f} to {estimate_s[-1]:.2f} s) is within half a frame of the "
            f"truth's ({truth_s[0]:.2f} to {truth_s[-1]:.2f} s); are they of one recording?"
        )
    return fits, nearest[fits]


def compare_tracks(
    estimate: ObjectTrack,
    truth: Truth,
    *,
    model: Any | None = None,
    symmetry: Symmetry | None = None,
    seed: int = 0,
) -> Comparison:
    """All metrics of a track. model: trimesh in the truth's object frame, for ADD; symmetry: over the truth's own.

    ADD compares poses of one object frame, so it is left out when estimate and truth name different meshes.
    """
    mesh = estimate.header.get("mesh", {})
    symmetry = symmetry or truth.symmetry or Symmetry()
    at, of = matched_frames(estimate.time_s, truth.time_s)
    size = estimate.header.get("image_size_px") or _size_from(estimate.camera_matrix)
    extents = mesh.get("extents_m")
    true_extent_m = truth.extent_m or (float(max(model.extents)) if model is not None else None)
    scale_m = float(max(extents)) if extents else true_extent_m
    if scale_m is None:
        raise UserError("neither track nor truth says how large the object is; give its mesh with --mesh")
    shared: dict[str, Any] = {
        "symmetry": symmetry,
        "camera_estimate": estimate.camera_matrix,
        "camera_truth": truth.camera_matrix,
        "image_size_px": (int(size[0]), int(size[1])),
    }
    one_frame = truth.mesh_sha256 is None or truth.mesh_sha256 == mesh.get("sha256")
    points = None
    if model is not None and one_frame and "library" not in mesh:
        points = model.vertices[np.random.default_rng(seed).permutation(len(model.vertices))[:MODEL_POINTS]]
    points_m = None if points is None else np.asarray(points, np.float64)
    T, T_truth = estimate.T_camera_object[at], truth.T_camera_object[of]
    first_camera = None
    if truth.T_first_camera is not None:
        T_first, T_first_truth = estimate.from_first_camera().T_camera_object[at], truth.T_first_camera[of] @ T_truth
        first_camera = pose_errors(T_first, T_first_truth, **shared, points_m=points_m)
    scales = {"scale_estimate_m": scale_m, "scale_truth_m": true_extent_m or scale_m}
    return Comparison(
        len(at),
        int(np.count_nonzero(estimate.visible[at])),
        {name: velocity_errors(T, T_truth, protocol=name, **shared, **scales) for name in PROTOCOLS},  # type: ignore[arg-type]
        pose_errors(T, T_truth, **shared, points_m=points_m),
        first_camera,
    )


def _size_from(camera: Array) -> tuple[int, int]:
    # Without a size in the header, the principal point is taken for the middle.
    return round(2 * float(camera[0, 2])), round(2 * float(camera[1, 2]))


def write_comparison(comparison: Comparison, path: Path) -> None:
    """The report as JSON."""
    from .files import write_json

    write_json(path, json.loads(json.dumps(comparison.to_json())))


def compare_files(
    estimate: Path, truth: Path, mesh: Path | None, mesh_unit: str, symmetry_order: int | None, out: Path | None
) -> dict[str, Any]:
    """Figures of a track against a truth, as `Comparison` holds them; written to `out` if given.

    Raises UserError when a file is missing, damaged, or the two are of different recordings.
    """
    from .meshes import load_mesh

    if symmetry_order is not None and symmetry_order < 0:
        raise UserError(f"--symmetry-order {symmetry_order} is negative; give 1 for none, 0 for a body of revolution")
    comparison = compare_tracks(
        ObjectTrack.load(estimate),
        load_truth(truth),
        model=None if mesh is None else load_mesh(mesh, mesh_unit),
        symmetry=None if symmetry_order is None else Symmetry(order=symmetry_order),
    )
    if out is not None:
        write_comparison(comparison, out)
    return comparison.to_json()
