"""Estimated poses as the BOP benchmark exchanges them: one line of a csv file for every object found.

The columns are scene_id, im_id, obj_id, score, R (nine numbers, row by row), t (three, MILLIMETRES) and time (seconds
for the picture, -1 if unknown). Two more may follow, for poses of other meshes than the data set's own: `mesh`,
"library:CATEGORY:SEED" or the path of a mesh file, and `size_m`, its largest full extent. Such a pose is of the mesh
moved so that the centre of its bounding box is the origin, and scaled to that size.

The files of the paper's authors are read too: their `obj_id` names a mesh, which is `ID/ID.obj` of their folder of
meshes, and `scale` is half of its largest extent in metres.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .bop import M_PER_MM, ImageKey
from .errors import UserError
from .files import write_text
from .geometry import Array, make_pose

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
MESH_COLUMNS = ("mesh", "size_m")
_ORTHONORMAL = 0.01  # how far an R in a file may be from a rotation, element by element of R R^T


@dataclass(frozen=True)
class Estimate:
    """One estimated pose.

    T_camera_object: (4, 4), m. score: higher is surer. time_s: for the whole picture, None if unknown.
    obj_id: the data set's model that this is taken for, 0 where it is not said.
    mesh, size_m: another mesh than that model and its largest full extent; None means the model itself.
    """

    image: ImageKey
    obj_id: int
    score: float
    T_camera_object: Array
    time_s: float | None = None
    mesh: str | None = None
    size_m: float | None = None


def write_results(path: Path, estimates: Sequence[Estimate]) -> None:
    """Write a results file atomically; the mesh columns only where an estimate has them."""
    with_mesh = any(e.mesh is not None for e in estimates)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*COLUMNS, *(MESH_COLUMNS if with_mesh else ())])
    for e in estimates:
        R, t_mm = e.T_camera_object[:3, :3], e.T_camera_object[:3, 3] / M_PER_MM
        row = [e.image.scene_id, e.image.im_id, e.obj_id, repr(float(e.score)), _spaced(R.ravel()), _spaced(t_mm)]
        row.append(-1 if e.time_s is None else f"{e.time_s:.6g}")
        if with_mesh:
            row += ["", ""] if e.mesh is None or e.size_m is None else [e.mesh, repr(float(e.size_m))]
        writer.writerow(row)
    write_text(path, stream.getvalue())


def read_results(path: Path | str) -> list[Estimate]:
    """The estimates of a results file. Raises UserError, naming file and line, for what is not as it should be."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"the results {path} cannot be read ({error}); give a csv file in BOP's format") from error
    reader = csv.reader(io.StringIO(text))
    header = [name.strip() for name in next(reader, [])]
    if missing := [name for name in COLUMNS if name not in header]:
        raise UserError(f"{path}, line 1: columns {', '.join(missing)} are missing; BOP's are {', '.join(COLUMNS)}")
    by_authors = "scale" in header and "mesh" not in header
    estimates = []
    for row in reader:
        if not any(cell.strip() for cell in row):
            continue
        where = f"{path}, line {reader.line_num}"
        if len(row) != len(header):
            raise UserError(f"{where} has {len(row)} columns, the first line {len(header)}")
        cells = dict(zip(header, map(str.strip, row), strict=True))
        estimates.append(_estimate(_of_authors(cells, where) if by_authors else cells, where))
    return estimates


def _estimate(cells: dict[str, str], where: str) -> Estimate:
    R = _numbers(cells, "R", 9, where).reshape(3, 3)
    t_mm = _numbers(cells, "t", 3, where)
    if np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(R) < 0:
        raise UserError(f"{where}: R is not a rotation (row by row, determinant +1)")
    time_s = float(_numbers(cells, "time", 1, where)[0])
    mesh, size_m = cells.get("mesh") or None, None
    if mesh is not None:
        size_m = float(_numbers(cells, "size_m", 1, where)[0])
        if size_m <= 0:
            raise UserError(f"{where}: size_m is {size_m:g}; give the mesh's largest extent in m")
    return Estimate(
        ImageKey(_whole(cells, "scene_id", where), _whole(cells, "im_id", where)),
        _whole(cells, "obj_id", where),
        float(_numbers(cells, "score", 1, where)[0]),
        make_pose(R, t_mm * M_PER_MM),
        None if time_s < 0 else time_s,
        mesh,
        size_m,
    )


def _of_authors(cells: dict[str, str], where: str) -> dict[str, str]:
    """A line of the authors' in this module's columns."""
    size_m = 2 * float(_numbers(cells, "scale", 1, where)[0])
    return {**cells, "obj_id": "0", "mesh": "{0}/{0}.obj".format(cells["obj_id"]), "size_m": repr(size_m)}


def _whole(cells: dict[str, str], name: str, where: str) -> int:
    try:
        return int(cells[name])
    except ValueError as error:
        raise UserError(f"{where}: {name} is {cells[name]!r}; give a whole number") from error


def _numbers(cells: dict[str, str], name: str, count: int, where: str) -> Array:
    text = cells.get(name, "")
    try:
        value = np.array([float(word) for word in text.split()])
    except ValueError:
        value = np.empty(0)
    if value.shape != (count,) or not np.all(np.isfinite(value)):
        raise UserError(f"{where}: {name} is {text!r}; give {count} finite number{'s' * (count > 1)}, spaces between")
    return value


def _spaced(values: Iterable[float]) -> str:
    return " ".join(repr(float(v)) for v in values)
