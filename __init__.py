"""Video of a person handling an object in, robot demonstrations out.

vid2demo recovers the 6D trajectory of a handled object from a video (`extract`), turns it into a
Gymnasium + MuJoCo environment with a Franka Panda and a reference-tracking reward (`envs`), records verified
demonstrations as a LeRobot dataset (`demos`) and trains and evaluates policies on them (`policies`).
Importing this package registers the environments and loads nothing heavy.
"""

from .envs.registration import register_envs

__version__ = "0.1.0"

register_envs()
