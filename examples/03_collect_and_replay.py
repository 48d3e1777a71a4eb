"""Collect verified demonstrations as a LeRobot dataset, replay them, and evaluate the open-loop policy.

python examples/03_collect_and_replay.py [REFERENCE]   # a *.reference.npz; default: the one of example 02
"""

from __future__ import annotations

import sys
from pathlib import Path

from vid2demo.demos.collect import collect
from vid2demo.demos.replay import as_text, replay
from vid2demo.policies.evaluate import evaluate
from vid2demo.policies.open_loop import OpenLoopPolicy


def main() -> None:
    reference = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example/mug.reference.npz")
    dataset = reference.parent / "dataset"
    collect(reference, dataset, episodes=2, seed=0, image_size=(96, 96))
    print(as_text(replay(dataset)))
    print(evaluate(OpenLoopPolicy(), reference, episodes=3, seed=1).as_text())


if __name__ == "__main__":
    main()
