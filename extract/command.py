"""What a command of the command line is made of; every room brings its own in a module `commands`.

A room's `commands.COMMANDS` maps the words that call a command to its class, and the command line gathers these tables.
The class is the parser: each field is an option, the docstring is the help and gives an example.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from .progress import Terminal
from .stages import Stage, plain, run_stages
from .wording import as_lines

Box = tuple[float, float, float, float]
Result = Mapping[str, Any]


def told(metavar: str | None, text: str) -> Any:
    """An option whose help tells its default in words, or a flag."""
    return arg(metavar=metavar, help=text, help_behavior_hint="")


Out = Annotated[Path, arg(metavar="DIR", help="Folder for the results; an interrupted command goes on in it.")]
Seed = Annotated[int, arg(metavar="N", help="Seed of every random draw [integer].")]
Episodes = Annotated[int, arg(metavar="N", help="Successful demonstrations to collect [count].")]
MeshUnit = Annotated[Literal["auto", "m", "cm", "mm", "in"], arg(help="Unit of length of --mesh.")]
Scale = Annotated[
    Literal["auto"] | float,
    arg(
        metavar="auto|FLOAT",
        help="Size of the robot's path over the video's [ratio]; auto keeps the video's where it pours well in the "
        "simulator, and else takes the size, receptacle place and tilt that pour best. 1.0: faithful.",
    ),
]
Category = Annotated[str, arg(metavar="NAME", help="What is poured from: a word or category of `meshes list`.")]
Receiver = Annotated[str, arg(metavar="NAME", help="What is poured into: a word or category of `meshes list`.")]


@dataclass(frozen=True, kw_only=True)
class Command:
    """What all commands have."""

    json: Annotated[bool, told(None, "Print the result as JSON on standard output.")] = False

    def do(self) -> Result:
        raise AssertionError("a command without work")

    def words(self, result: Result) -> str:
        """The result for a person."""
        return "\n".join(as_lines(result))

    def status(self, result: Result) -> int:
        """The exit status: 0 when all is well, 1 when the work is done and its finding is bad."""
        return 0


@dataclass(frozen=True, kw_only=True)
class Staged(Command):
    """A command that writes a folder stage by stage."""

    out: Out
    force: Annotated[bool, told(None, "Do every stage again, even what has not changed.")] = False

    def do_stages(
        self, stages: Sequence[Stage], settings: Mapping[str, Any], video: Mapping[str, Any] | None = None
    ) -> Result:
        name = re.sub(r"(?<!^)(?=[A-Z])", " ", type(self).__name__).lower()
        record = run_stages(
            self.out, stages, command=name, settings=plain(settings), video=video, force=self.force, listener=Terminal()
        )
        return record | {"stages": {stage.name: record["stages"][stage.name] for stage in stages}}

    def words(self, result: Result) -> str:
        text = [line for stage in result["stages"].values() for line in as_lines(stage["figures"])]
        written = [name for stage in result["stages"].values() for name in stage["outputs"]]
        text.append(f"written to {self.out}: {', '.join(written)}")
        return "\n".join([*text, *(f"open {self.out / name}" for name in written if name == "report.html")])


Commands = Mapping[str, type[Command]]
"""What a room brings: the word that calls a command, or the two words ("meshes list"), -> the command.

Where both `word` and `word other` are commands, the first takes options only, no words of its own."""
