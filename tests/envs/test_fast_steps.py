from __future__ import annotations

import mujoco
import numpy as np
from vid2demo.envs.liquid import Liquid
from vid2demo.envs.reference import Reference
from vid2demo.envs.simulation import Simulation


def test_the_compiled_steps_are_those_of_engine_and_liquid_in_turn(mug_pour: Reference) -> None:
    compiled = Simulation(mug_pour, 20, Liquid(solver="fast"), 0.002, 20)
    plain = compiled.twin(mug_pour)
    for simulation in (compiled, plain):
        simulation.begin(mug_pour.q_start_rad, mug_pour.T_world_receptacle[:3, 3])
    vessel = int(plain.model.body("vessel").id)
    liquid = plain._fast
    assert liquid is not None
    for period in range(10):
        shift_rad = 0.02 * np.sin(period) * np.arange(7) * np.linspace(0.0, 1.0, 20)[:, None]
        commands = mug_pour.q_start_rad + shift_rad
        compiled.advance(commands)
        T_after = plain.T_world_vessel
        for command in commands:
            plain.data.ctrl[:7] = command
            mujoco.mj_step(plain.model, plain.data)
            mujoco.mj_kinematics(plain.model, plain.data)
            T_before, T_after = T_after, plain.T_world_vessel
            fx, fy, fz, tx, ty, tz = liquid.step(T_before, T_after, plain.T_world_receptacle)
            x, y, z = plain.vessel_m - plain.data.xipos[vessel]
            push = [fx, fy, fz, tx + y * fz - z * fy, ty + z * fx - x * fz, tz + x * fy - y * fx]
            plain.data.xfrc_applied[vessel] = push
        ours, expected = compiled.get_state(), plain.get_state()
        assert all(np.array_equal(ours[name], expected[name]) for name in expected)
    assert np.abs(plain.data.xfrc_applied[vessel]).max() > 0.01, "the liquid should push the vessel"
