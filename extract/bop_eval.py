"""Judging a results file against a data set: average recalls of CoU, CH and pCH, scale error, and what else applies."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .bop import Dataset, ImageKey, TrueObject, open_dataset, read_json
from .bop_results import Estimate, read_results
from .errors import UserError
from .geometry import Array
from .metrics import AUC_LIMIT_M, area_under_recall, point_distances
from .pose_metrics import METRICS, Placed, Protocol, Shape, pose_error, recalls
from .progress import Progress

SAME_OBJECT_IOU = 0.25  # of silhouettes, from which on an estimate is taken to mean a true object
CATEGORIES_FILE, DATABASE_FILE = "categories.json", "database.json"
_POINTS = 1000


@dataclass(frozen=True)
class Scores:
    """What a results file is worth.

    ar_*: average recalls in percent, `ar` the mean of the three. recall: metric -> ten recalls in percent, at
    `pose_metrics.limits`; by_object: object id -> its targets and average recalls. targets, estimates, images: counts.
    The further ones are of the targets that an estimate clearly means, `matched` of them: scale_error_percent, the
    median error of the largest extent; where the estimate is of the data set's own model, the medians adds_m and
    rotation_deg (up to symmetry), and the share of ADD-S up to 10 cm; and where the data set tells categories (in
    `categories.json` and `database.json`, as `synthesize bop` writes them) category_percent, how often a mesh is of the
    right one.
    """

    protocol: str
    ar: float
    ar_cou: float
    ar_ch: float
    ar_pch: float
    targets: int
    estimates: int
    images: int
    matched: int
    scale_error_percent: float | None
    adds_m: float | None = None
    adds_auc_percent: float | None = None
    rotation_deg: float | None = None
    category_percent: float | None = None
    seconds_per_image: float | None = None
    recall: dict[str, list[float]] = field(default_factory=dict)
    by_object: dict[str, dict[str, float]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> Scores:
        return Scores(**value)

    def table(self) -> str:
        """The figures for a person."""
        lines = [
            f"{self.targets} targets in {self.images} images, {self.estimates} estimates, protocol {self.protocol}",
            "recall [%] at the limits  " + "".join(f"{n:>7}" for n in range(1, 11)) + "   average",
        ]
        titles = {"cou": "CoU (0.05 ... 0.5)", "ch": "CH (0.05 ... 0.5 d)", "pch": "pCH (5 ... 50 px)"}
        for metric, title in titles.items():
            shares = self.recall[metric]
            lines.append(f"{title:<26}" + "".join(f"{v:7.1f}" for v in shares) + f"{sum(shares) / len(shares):10.2f}")
        lines.append(f"{'AR':<26}{self.ar:80.2f}")
        further = {
            "median scale error [%]": self.scale_error_percent,
            "median ADD-S [m]": self.adds_m,
            "ADD-S AUC to 10 cm [%]": self.adds_auc_percent,
            "median rotation error [deg]": self.rotation_deg,
            "meshes of the right category [%]": self.category_percent,
            "time [s/image]": self.seconds_per_image,
        }
        lines += [f"{title}: {value:.4g}" for title, value in further.items() if value is not None]
        return "\n".join([*lines, f"{self.matched} targets are clearly meant by an estimate"])


def evaluate_files(
    dataset: Path, results: Path, *, split: str | None, protocol: Protocol, meshes: Path | None, progress: Progress
) -> Scores:
    """`evaluate` on files. meshes: folder in which the results' meshes lie, if not beside the results."""
    return evaluate(
        open_dataset(dataset, split),
        read_results(results),
        protocol=protocol,
        folders=(*([meshes] if meshes else []), results.parent, dataset),
        progress=progress,
    )


def evaluate(
    dataset: Dataset,
    estimates: Sequence[Estimate],
    *,
    protocol: Protocol = "official",
    folders: Sequence[Path] = (Path(),),
    progress: Progress | None = None,
) -> Scores:
    """Judge estimates against a data set's targets. folders: where the estimates' mesh files may lie.

    Raises UserError when an estimate is of a picture that the data set does not have, or its mesh is not found.
    """
    if strangers := {e.image for e in estimates} - set(dataset.images):
        first = min(strangers)
        raise UserError(
            f"the results tell of scene {first.scene_id}, image {first.im_id}, which {dataset.root} does not have; "
            "name the data set or the split that they are of"
        )
    wanted = targets_of(dataset)
    by_image: dict[ImageKey, list[Estimate]] = defaultdict(list)
    for estimate in estimates:
        by_image[estimate.image].append(estimate)
    shapes = _Shapes(dataset, folders)
    found: dict[str, list[NDArray[np.bool_]]] = {metric: [] for metric in METRICS}
    of_object: list[int] = []
    pairs: list[tuple[Estimate, TrueObject]] = []
    off_percent: list[float] = []
    for done, (image, truths) in enumerate(sorted(wanted.items()), start=1):
        camera, size_px = dataset.camera_matrix(image), dataset.size_px(image)
        true = [Placed(shapes.own(t.obj_id), t.T_camera_object, camera, size_px, protocol) for t in truths]
        of_image = by_image[image]
        placed = [Placed(shapes.of(e), e.T_camera_object, camera, size_px, protocol) for e in of_image]
        scores = np.array([e.score for e in of_image])
        of_object += [t.obj_id for t in truths]
        allowed = np.array([[_may_mean(e, t, protocol) for t in truths] for e in of_image], bool)
        allowed = allowed.reshape(len(placed), len(true))
        diameters_m = [dataset.models[t.obj_id].diameter_m for t in truths]
        counts = Counter(t.obj_id for t in truths)
        only_best = [protocol == "official" and counts[t.obj_id] == 1 for t in truths]
        order = None
        for metric in METRICS:
            errors = _errors(metric, placed, true, diameters_m, allowed, order, only_best)
            order = np.argsort(errors, axis=0) if metric == "cou" else order
            found[metric].append(recalls(errors, metric, protocol, scores, [t.obj_id for t in truths]))
            if metric == "cou":
                meant = _meant(errors)
                pairs += [(of_image[k], truths[n]) for n, k in meant]
                off_percent += [100 * abs(placed[k].shape.size_m / true[n].shape.size_m - 1) for n, k in meant]
        if progress is not None:
            progress(done, len(wanted), "judging")
    right = {metric: np.concatenate([np.zeros((10, 0), bool), *found[metric]], axis=1) for metric in METRICS}
    count = len(of_object)
    recall = {metric: (100 * right[metric].sum(axis=1) / max(count, 1)).tolist() for metric in METRICS}
    average = {metric: float(np.mean(recall[metric])) for metric in METRICS}
    times = {e.image: e.time_s for e in estimates if e.time_s is not None}
    return Scores(
        protocol,
        float(np.mean(list(average.values()))),
        average["cou"],
        average["ch"],
        average["pch"],
        count,
        len(estimates),
        len(wanted),
        len(pairs),
        _median(off_percent),
        **_of_own_models([(e, t) for e, t in pairs if e.mesh is None and e.obj_id == t.obj_id], dataset),
        category_percent=_right_category(pairs, dataset.root),
        seconds_per_image=float(np.mean(list(times.values()))) if times else None,
        recall=recall,
        by_object=_by_object(right, np.array(of_object, int)),
    )


def targets_of(dataset: Dataset) -> dict[ImageKey, list[TrueObject]]:
    """The true objects to be found in each picture: of each target's object the most visible ones, as many as asked."""
    wanted: dict[ImageKey, list[TrueObject]] = defaultdict(list)
    for target in dataset.targets:
        there = [t for t in dataset.objects(target.image) if t.obj_id == target.obj_id]
        there.sort(key=lambda t: -(1.0 if t.visible_fraction is None else t.visible_fraction))
        wanted[target.image] += there[: target.count]
    return dict(wanted)


def find_mesh(name: str, folders: Sequence[Path]) -> Any:
    """The trimesh.Trimesh that a results file names: "library:CATEGORY:SEED", or a file, in one of the folders.

    Its unit does not matter, for the results give its size. Raises UserError when there is no such mesh.
    """
    if name.startswith("library:"):
        from .vessels import make_vessel

        _, _, rest = name.partition(":")
        category, _, seed = rest.partition(":")
        if seed and not seed.isdecimal():
            raise UserError(f"the results name the mesh {name!r}; give library:CATEGORY:SEED with a whole number")
        return make_vessel(category, int(seed) if seed else None).mesh
    for folder in folders:
        if (path := folder / name).is_file():
            import trimesh

            return trimesh.load(path, force="mesh")
    raise UserError(
        f"the results name the mesh {name!r}, which is in none of {', '.join(map(str, folders))}; name its --meshes"
    )


class _Shapes:
    """The shapes of a data set's models, and of other meshes that estimates name, of which only the last are kept."""

    def __init__(self, dataset: Dataset, folders: Sequence[Path]) -> None:
        self._dataset = dataset
        self.own = cache(self._own)
        self._unsized = lru_cache(maxsize=32)(lambda name: find_mesh(name, folders))
        self._other = lru_cache(maxsize=64)(lambda name, size_m: Shape.of(self._unsized(name), size_m))

    def of(self, estimate: Estimate) -> Shape:
        """What an estimate is a pose of."""
        return self.own(estimate.obj_id) if estimate.mesh is None else self._other(estimate.mesh, estimate.size_m)

    def _own(self, obj_id: int) -> Shape:
        if obj_id not in self._dataset.models:
            raise UserError(f"the results tell of object {obj_id}, of which {self._dataset.root} has no model")
        return Shape.of(self._dataset.mesh(obj_id))


def _may_mean(estimate: Estimate, truth: TrueObject, protocol: Protocol) -> bool:
    """The paper's protocol keeps to the object that an estimate names; the official one tries all on all."""
    return protocol == "official" or estimate.mesh is not None or estimate.obj_id == truth.obj_id


def _errors(
    metric: str,
    placed: Sequence[Placed],
    true: Sequence[Placed],
    diameters_m: Sequence[float],
    allowed: NDArray[np.bool_],
    order: NDArray[np.int64] | None,
    only_best: Sequence[bool],
) -> Array:
    """Errors (E, T) of estimates of true objects.

    order: (E, T) which estimates to try first on each object; only_best: of which objects only the least error counts.
    """
    errors = np.full(allowed.shape, np.inf)
    for n, truth in enumerate(true):
        enough = np.inf
        for k in range(len(placed)) if order is None else order[:, n]:
            if allowed[k, n]:
                errors[k, n] = pose_error(metric, placed[k], truth, diameters_m[n], enough)
                if only_best[n]:
                    enough = min(enough, errors[k, n])
    return errors


def _by_object(right: Mapping[str, NDArray[np.bool_]], of_object: NDArray[np.int64]) -> dict[str, dict[str, float]]:
    told = {}
    for obj_id in np.unique(of_object):
        own = of_object == obj_id
        average = {f"ar_{metric}": float(100 * right[metric][:, own].mean()) for metric in METRICS}
        told[str(obj_id)] = {"targets": int(own.sum())} | average
    return told


def _meant(errors: Array) -> list[tuple[int, int]]:
    """(truth, estimate) where the estimate covers the truth best, and well enough to mean it."""
    if errors.size == 0:
        return []
    best = np.argmin(errors, axis=0)
    return [(n, int(k)) for n, k in enumerate(best) if errors[k, n] <= 1 - SAME_OBJECT_IOU]


def _of_own_models(pairs: Sequence[tuple[Estimate, TrueObject]], dataset: Dataset) -> dict[str, float | None]:
    """ADD-S and geodesic errors, which need the same mesh on both sides."""
    if not pairs:
        return {}
    points = {obj_id: _some_points(dataset.mesh(obj_id)) for obj_id in {t.obj_id for _, t in pairs}}
    adds_m, rotation_rad = [], []
    for estimate, truth in pairs:
        T, T_true = estimate.T_camera_object[None], truth.T_camera_object[None]
        adds_m.append(float(point_distances(T, T_true, points[truth.obj_id])[1][0]))
        symmetry = dataset.models[truth.obj_id].symmetry
        rotation_rad.append(symmetry.error_rad(T[0, :3, :3], T_true[0, :3, :3]))
    return {
        "adds_m": _median(adds_m),
        "adds_auc_percent": area_under_recall(np.array(adds_m), AUC_LIMIT_M),
        "rotation_deg": float(np.rad2deg(np.median(rotation_rad))),
    }


def _right_category(pairs: Sequence[tuple[Estimate, TrueObject]], root: Path) -> float | None:
    """Percent of the pairs with another mesh than the true one whose mesh is of the true category."""
    told = [(e.mesh, t.obj_id) for e, t in pairs if e.mesh is not None]
    if not told or not all((root / name).is_file() for name in (CATEGORIES_FILE, DATABASE_FILE)):
        return None
    true = read_json(root / CATEGORIES_FILE)
    known: dict[str, str] = {}
    for entry in read_json(root / DATABASE_FILE):
        known[entry["name"]] = entry["category"]
        if "library" in entry:
            known["library:{category}:{seed}".format(**entry["library"])] = entry["category"]
    named = [(mesh if mesh in known else Path(mesh).stem, true[str(obj_id)]) for mesh, obj_id in told]
    return float(100 * np.mean([known.get(name) == category for name, category in named]))


def _some_points(mesh: Any) -> Array:
    import trimesh

    return np.asarray(trimesh.sample.sample_surface(mesh, _POINTS, seed=0)[0], float)


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None
