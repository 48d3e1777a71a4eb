"""The policy that looks at nothing: it plays joint targets on the clock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..demos.joints import JointTrajectory
from ..demos.rollout import ActionPlayer, Info, Observation, ReferencePlayer, joint_actions
from ..extract.errors import UserError


class OpenLoopPolicy:
    """Absolute joint targets, one per control step, the last one held until the episode ends.

    joints: the motion to play in every episode, or the path of a `*.joints.npz`; None retargets the reference of each
        episode anew, and so follows where its start and receptacle were moved to.
    """

    def __init__(self, joints: JointTrajectory | Path | str | None = None) -> None:
        self.joints = JointTrajectory.load(Path(joints)) if isinstance(joints, str | Path) else joints
        self.name = "open loop, fixed" if self.joints is not None else "open loop"
        self._player: ActionPlayer | ReferencePlayer = ReferencePlayer()

    def reset(self, env: Any, observation: Observation, info: Info) -> None:
        """Raises UserError when the environment takes other actions or another rate, or the arm cannot follow."""
        control_mode = getattr(env.unwrapped, "control_mode", "joint_position")
        if control_mode != "joint_position":
            raise UserError(
                f"the open-loop policy plays joint positions, the environment has control_mode {control_mode!r}; "
                "make it with control_mode='joint_position'"
            )
        if self.joints is not None:
            joints_hz = (len(self.joints) - 1) / float(self.joints.time_s[-1] - self.joints.time_s[0])
            env_hz = float(env.unwrapped.metadata["render_fps"])
            if abs(joints_hz - env_hz) > 1e-3 * env_hz:
                raise UserError(
                    f"the joint motion has {joints_hz:.6g} knots a second, the environment {env_hz:.6g} steps; "
                    f"make it with control_hz={joints_hz:.6g}"
                )
            self._player = ActionPlayer(joint_actions(self.joints, env))
        self._player.reset(env, observation, info)

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """(7,) joint targets in rad."""
        return self._player.act(observation)
