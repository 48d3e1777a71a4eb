from __future__ import annotations

import os
import subprocess
import sys

import pytest

DRAW = """
from vid2demo.extract.offscreen import load_mujoco
mujoco = load_mujoco()
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
    renderer.update_scene(data)
    print(renderer.render().std() > 1)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="EGL is for Linux")
@pytest.mark.parametrize("before", ["", "import mujoco\n"])
def test_renders_without_a_screen_whoever_imports_mujoco_first(before: str) -> None:
    environment = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")}
    result = subprocess.run(
        [sys.executable, "-c", before + DRAW], env=environment, capture_output=True, text=True, timeout=120
    )
    assert result.stdout.strip() == "True", result.stderr[-800:]


@pytest.mark.skipif(sys.platform != "linux", reason="EGL is for Linux")
def test_a_choice_of_the_user_is_left_alone() -> None:
    code = (
        "import os; from vid2demo.extract.offscreen import load_mujoco; load_mujoco(); print(os.environ['MUJOCO_GL'])"
    )
    environment = {**os.environ, "MUJOCO_GL": "disable"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert result.stdout.strip() == "disable", result.stderr[-800:]
