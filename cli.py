"""The command `vid2demo`: gathers the commands of all rooms, parses, calls, prints.

Everything heavy is imported by the command that needs it, when it is called.
"""

from __future__ import annotations

import difflib
import inspect
import json
import os
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, arg

from . import __version__
from .demos import commands as demos
from .extract import commands as extract
from .extract.command import Category, Command, Commands, Episodes, Out, Receiver, Result, Scale, Seed, Staged
from .extract.errors import UserError
from .extract.progress import Terminal
from .extract.stages import plain


@dataclass(frozen=True, kw_only=True)
class Run(extract.FromVideo):
    """Do the whole way: a video in; tracks, a robot motion, a dataset and a report out.

    What has not changed is not done again, so the same command goes on where it was interrupted. It ends by naming
    the report to open.

    For example: vid2demo run coffee.mp4 --object kettle --receptacle mug --out runs/coffee --episodes 10
    """

    scale: Scale = "auto"
    episodes: Episodes = 10

    def do(self) -> Result:
        from .run import RunSettings, run

        settings = RunSettings(**vars(self.settings()), scale=self.scale, episodes=self.episodes)
        return run(settings, self.out, force=self.force, listener=Terminal())


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """Write report.html of a run's folder anew: one page with videos, plots, findings and the next commands.

    For example: vid2demo report runs/coffee
    """

    folder: Positional[Annotated[Path, arg(metavar="DIR", help="Folder of a run, with its run.json.")]]

    def do(self) -> Result:
        from .report import write_report

        return {"report": str(write_report(self.folder))}


@dataclass(frozen=True, kw_only=True)
class Demo(Staged):
    """Show the whole way without a video of yours: render a clip to DIR/clip, then do `run` on it.

    For example: vid2demo demo --out runs/demo
    """

    out: Out = Path("runs/demo")
    category: Category = "mug"
    receptacle: Receiver = "bowl"
    seconds: Annotated[float, arg(metavar="S", help="Length of the clip [s].")] = 6.0
    episodes: Episodes = 3
    seed: Seed = 0

    def do(self) -> Result:
        from .run import demo

        chosen: dict[str, Any] = {"category": self.category, "receptacle": self.receptacle, "seed": self.seed}
        clip = self.out / "clip"
        extract.Synthesize(out=clip, force=self.force, seconds=self.seconds, **chosen).do()
        return demo(clip, self.out, **chosen, episodes=self.episodes, force=self.force, listener=Terminal())


COMMANDS: Commands = {"run": Run, **extract.COMMANDS, **demos.COMMANDS, "report": Report, "demo": Demo}


def usage() -> str:
    """What `vid2demo --help` prints."""
    return f"""usage: vid2demo COMMAND [options]

A video of a person pouring in; a robot environment, verified robot demonstrations and a report out.

Begin with one of
  vid2demo demo
  vid2demo run VIDEO --object kettle --receptacle mug --out runs/coffee

commands:
{_listed(COMMANDS)}

  vid2demo COMMAND --help tells a command's options, with an example;  vid2demo --version tells the version"""


def _listed(names: Iterable[str]) -> str:
    width = max(map(len, COMMANDS))
    return "\n".join(f"  {name:<{width}} {(COMMANDS[name].__doc__ or '').splitlines()[0]}" for name in names)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Returns the exit status: 0 good, 1 not all well, 2 bad input, 130 interrupted."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")  # no screen is needed
    try:
        status = _dispatch(words)
        sys.stdout.flush()
        return status
    except UserError as error:
        print(f"vid2demo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nvid2demo: interrupted; to go on, type again:", shlex.join(["vid2demo", *words]), file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _dispatch(words: list[str]) -> int:
    name = words[0] if words else "--help"
    if name in ("-h", "--help", "help"):
        print(usage())
        return 0 if words else 2
    if name == "--version":
        print(f"vid2demo {__version__}")
        return 0
    under = [command for command in COMMANDS if command.startswith(f"{name} ")]
    if under and len(words) > 1 and not words[1].startswith("-"):
        name = f"{name} {words[1]}"
    elif under and name not in COMMANDS:
        print(f"usage: vid2demo {name} COMMAND [options]\n\ncommands:\n{_listed(under)}")
        return 0 if words[1:] in (["-h"], ["--help"]) else 2
    if name not in COMMANDS:
        hint = "".join(f" (did you mean {close}?)" for close in difflib.get_close_matches(name, COMMANDS, n=1))
        raise UserError(f"unknown command {name!r}{hint}; there are {', '.join(under or COMMANDS)}")
    chosen, rest = COMMANDS[name], words[len(name.split()) :]
    text = inspect.getdoc(chosen) or ""
    if under and " " not in name:
        text += f"\n\nOther commands:\n{_listed(under)}"
    command = tyro.cli(
        chosen, prog=f"vid2demo {name}", description=text, args=rest, config=(tyro.conf.FlagCreatePairsOff,)
    )
    result = plain(command.do())
    print(json.dumps(result, indent=2, allow_nan=False) if command.json else command.words(result))
    return command.status(result)
