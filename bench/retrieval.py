"""How often the right category is retrieved, by which descriptor, and what a search costs.

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/retrieval.py DATASET [--db DB] [--views 600] [--json]
    OMP_NUM_THREADS=1 python bench/retrieval.py --cost [--objects 50000] [--json]
    OMP_NUM_THREADS=1 python bench/retrieval.py --onboarding [--objects 24] [--views 600] [--json]

DATASET is what `vid2demo synthesize bop` writes: its pictures show variants that its database does not hold. Objects
are given by their visible masks. Without DATASET it is rendered to runs/tables first. The database is made in
DATASET/views when --db is not given. Beside the descriptors stand a blind guess and the moments of the silhouette.
`--cost` fabricates a database of 50,000 objects of 600 views (sparse files) and times opening and searching it.
`--onboarding` times the library's vessels by one worker and by two.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from retrieval_baselines import by_moments
from vid2demo.extract.bop import open_dataset
from vid2demo.extract.bop_commands import SynthesizeBop
from vid2demo.extract.features import ClassicalFeatures, features_of
from vid2demo.extract.mesh_sources import find_sources, library_sources
from vid2demo.extract.mesh_store import About, MeshStore
from vid2demo.extract.neural_segment import FOR_IMAGES, large_enough
from vid2demo.extract.onboarding import onboard
from vid2demo.extract.protocols import Image, Mask
from vid2demo.extract.retrieval import Look, Retriever, look_at_object, vote
from vid2demo.extract.templates import ViewSettings

DATASET = Path("runs/tables")
CLEAR = 0.95  # visible share from which on an object counts as unhidden
SEARCHES = 15


def rank(scores: NDArray[Any], categories: list[str], wanted: str) -> int:
    """At which place, from 0, the wanted category first comes, categories in the order of their best object."""
    order = list(dict.fromkeys(categories[k] for k in np.argsort(-scores, kind="stable")))
    return order.index(wanted) if wanted in order else len(order)


def accuracy(dataset_folder: Path, db: Path | None, views: int) -> dict[str, Any]:
    """Shares of objects whose category comes first, and among the first five, by method."""
    root = db or dataset_folder / "views"
    if db is None:
        onboard(find_sources(dataset_folder), root, settings=ViewSettings(count=views))
    store = MeshStore.open(root, "classical", views)
    features = features_of(store.encoder)
    dataset = open_dataset(dataset_folder)
    named = json.loads((dataset_folder / "categories.json").read_text("utf-8"))
    seen: list[tuple[str, float, Mask, Look]] = []
    seconds = 0.0
    for image in dataset.images:
        rgb: Image = dataset.rgb(image)
        for there in dataset.objects(image):
            mask = dataset.mask(image, there.index)
            if mask is None or not large_enough(mask, FOR_IMAGES):
                continue
            start = time.process_time()
            look = look_at_object(features, store.settings.extend, [(rgb, mask)])
            seconds += time.process_time() - start
            seen.append((named[str(there.obj_id)], float(there.visible_fraction or 0.0), mask, look))
    retrievers = {column: Retriever(store, column) for column in ("summary", "average")}
    categories = [about.category for about in retrievers["summary"].abouts]
    keys = retrievers["summary"].index.keys

    def by_views(column: str, best_views: int) -> Callable[[Mask, Look], NDArray[Any]]:
        def scores(mask: Mask, look: Look) -> NDArray[Any]:
            hits = retrievers[column].retrieve(look, top=len(keys), short_list=len(keys), best_views=best_views)
            found = {hit.key: hit.score for hit in hits}
            return np.array([found[key] for key in keys])

        return scores

    names, by_hu = by_moments(dataset_folder)
    place = [names.index(about.name) for about in retrievers["summary"].abouts]
    methods: dict[str, Callable[[Mask, Look], NDArray[Any]]] = {
        "silhouette moments, nearest view": lambda mask, look: by_hu(mask)[place],
        "FFA, one descriptor an object": by_views("average", 0),
        "FFA, best 2 views": by_views("average", 2),
        "summary, one descriptor an object": by_views("summary", 0),
        "summary, best view": by_views("summary", 1),
        "summary, best 2 views (the default)": by_views("summary", 2),
        "summary, best 25 views (the authors')": by_views("summary", 25),
    }
    clear = np.array([visible > CLEAR for _, visible, _, _ in seen])
    known = sorted(set(categories))
    share = np.array([categories.count(name) / len(categories) for name in known])
    rows = [{"method": "chance", "top1": float((share**2).sum()), "top5": min(5 / len(known), 1.0)}]
    for method, score in methods.items():
        start = time.process_time()
        ranks = np.array([rank(score(mask, look), categories, name) for name, _, mask, look in seen])
        each_ms = 1e3 * (time.process_time() - start) / len(seen)
        row: dict[str, Any] = {"method": method, "top1": float(np.mean(ranks == 0)), "top5": float(np.mean(ranks < 5))}
        row |= {"top1_clear": float(np.mean(ranks[clear] == 0)), "top1_hidden": float(np.mean(ranks[~clear] == 0))}
        rows.append(row | {"ms": each_ms})
    return {
        "objects_seen": len(seen),
        "clear": int(clear.sum()),
        "database": {"meshes": len(keys), "categories": len(known), "encoder": store.encoder},
        "look_ms": 1e3 * seconds / len(seen),
        "rows": rows,
    }


def fabricate(root: Path, objects: int, size: int) -> MeshStore:
    """A database of sparse files: every record has its full length, hardly any of it is on the disk."""

    class Wide(ClassicalFeatures):
        patch_size = size  # type: ignore[assignment]
        summary_size = size  # type: ignore[assignment]

    store = MeshStore.create(root, ViewSettings(), Wide(name="classical-wide"))
    for number in range(objects):
        key = f"{number * 2654435761 % 2**32:08x}{number:056x}"
        path = store.views_folder / key[:2] / f"{key}.npy"
        path.parent.mkdir(exist_ok=True)
        with open(path, "wb") as stream:
            stream.truncate(store.dtype.itemsize + 128)
    keys = store.keys()
    folder = store.index_folder(keys)
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((objects, size), np.float32)
    matrix /= np.linalg.norm(matrix, axis=1, keepdims=True)
    for column in ("average", "summary"):
        np.save(folder / f"{column}.npy", matrix)
    about = asdict(About("thing", "things", "objaverse/glbs/thing.glb", (0.0,) * 3, 1.0, "m", (0.1, 0.1, 0.1), 1000))
    (folder / "keys.json").write_text(json.dumps(keys))
    (folder / "about.json").write_text(json.dumps([about] * objects))
    return store


def opening(root: Path) -> dict[str, float]:
    """In a process of its own: seconds to open a database and its index, and what that adds to its memory in MB."""
    before = resident_mb()
    start = time.perf_counter()
    retriever = Retriever(MeshStore.open(root))
    opened = time.perf_counter() - start
    names = time.perf_counter()
    retriever.index.about_row(0)
    read = time.perf_counter() - names
    after = resident_mb()
    return {"objects": len(retriever.index), "open_s": opened, "names_s": read, "added_mb": after - before, "mb": after}


def resident_mb() -> float:
    """What this process holds in memory now."""
    text = Path("/proc/self/status").read_text()
    return int(next(line.split()[1] for line in text.splitlines() if line.startswith("VmRSS"))) / 1024


def median_ms(work: Callable[[], Any]) -> float:
    took = []
    for _ in range(SEARCHES):
        start = time.perf_counter()
        work()
        took.append(time.perf_counter() - start)
    return 1e3 * float(np.median(took))


def cost(objects: int, size: int = 1024) -> dict[str, Any]:
    """Opening and searching a large database; the bare product is of the same matrix, in memory."""
    with tempfile.TemporaryDirectory() as folder:
        fabricate(Path(folder) / "db", objects, size)
        command = [sys.executable, __file__, "--opening", str(Path(folder) / "db")]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        retriever = Retriever(MeshStore.open(Path(folder) / "db"))
        matrix = np.array(retriever.index.summary)
        queries = np.ascontiguousarray(matrix[:30])
        query = queries[0].copy()
        bare = median_ms(lambda: matrix @ query)
        return json.loads(done.stdout) | {
            "bare_product_ms": bare,
            "search_ms": median_ms(lambda: np.argpartition(-vote(retriever.index.summary, queries[:1]), 100)[:100]),
            "search_30_frames_ms": median_ms(lambda: np.argpartition(-vote(retriever.index.summary, queries), 100)),
        }


def onboarding(meshes: int, views: int) -> dict[str, float]:
    """What a mesh costs, by one worker and by two: time on the clock, and of all processors, start-up included."""
    sources = library_sources(1 + meshes // 23)[:meshes]
    found: dict[str, float] = {"meshes": len(sources), "views": views}
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            begin_s, used_s = time.perf_counter(), processor_s()
            onboard(sources, Path(folder) / "db", settings=ViewSettings(count=views), workers=workers)
            found[f"clock_s_{workers}"] = (time.perf_counter() - begin_s) / meshes
            found[f"processor_s_{workers}"] = (processor_s() - used_s) / meshes
    return found


def processor_s() -> float:
    """Processor time of this process and its ended children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def as_text(found: dict[str, Any]) -> str:
    if "rows" not in found:
        return "\n".join(f"{name:<22} {value:10.2f}" for name, value in found.items())
    lines = [f"{found['objects_seen']} objects, {found['clear']} of them unhidden; {found['database']}"]
    lines += [f"looking at one takes {found['look_ms']:.1f} ms"]
    lines += [f"{'method':<40} {'top-1':>6} {'top-5':>6} {'unhidden':>9} {'hidden':>7} {'ms':>7}"]
    for row in found["rows"]:
        rest = ""
        if "ms" in row:
            rest = f" {100 * row['top1_clear']:>9.1f} {100 * row['top1_hidden']:>7.1f} {row['ms']:>7.1f}"
        lines.append(f"{row['method']:<40} {100 * row['top1']:>6.1f} {100 * row['top5']:>6.1f}{rest}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, nargs="?")
    parser.add_argument("--db", type=Path)
    parser.add_argument("--cost", action="store_true")
    parser.add_argument("--onboarding", action="store_true")
    parser.add_argument("--objects", type=int, help="of --cost: 50000; of --onboarding: 24")
    parser.add_argument("--views", type=int, default=600)
    parser.add_argument("--opening", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    if chosen.opening:
        print(json.dumps(opening(chosen.opening)))
        return
    if chosen.cost:
        found = cost(chosen.objects or 50_000)
    elif chosen.onboarding:
        found = onboarding(chosen.objects or 24, chosen.views)
    else:
        if chosen.dataset is None:
            SynthesizeBop(out=DATASET).do()
        found = accuracy(chosen.dataset or DATASET, chosen.db, chosen.views)
    print(json.dumps(found, indent=2) if chosen.json else as_text(found))


if __name__ == "__main__":
    main()
