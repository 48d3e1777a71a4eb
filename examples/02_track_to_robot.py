"""From a track to a Panda motion, played in the Gymnasium environment.

python examples/02_track_to_robot.py [TRACK]      # a *.track.npz; default: the one of example 01
"""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium as gym
from vid2demo.demos.feasibility import feasibility
from vid2demo.demos.retarget import retarget
from vid2demo.envs.placement import build_reference
from vid2demo.extract.track import ObjectTrack

path = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example/mug.track.npz")
reference = build_reference(ObjectTrack.load(path))
reference.save(path.parent / "mug.reference.npz")
joints = retarget(reference)
for sentence in feasibility(reference, joints)["words"]:
    print("-", sentence)

env = gym.make("vid2demo:PandaPour-v0", reference=reference, num_particles=50)
observation, info = env.reset(seed=0)
done, step = False, 0
while not done:
    step = min(step + 1, len(joints.q_rad) - 1)
    observation, reward, terminated, truncated, info = env.step(joints.q_rad[step].astype("float32"))
    done = terminated or truncated
print(f"poured {info['poured_fraction']:.0%}, spilled {info['spilled_fraction']:.0%}, success {info['is_success']}")
env.close()
