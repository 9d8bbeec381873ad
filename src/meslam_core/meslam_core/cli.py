"""The `meslam` command.

Exit status: 0 when it worked, 2 for bad usage or input that cannot be read (in part: what could be
read is used, and the rest is stated), 3 when tracking was lost and never recovered, 130 when the
user interrupted a run. Messages go to standard error, results to standard output.
"""

from __future__ import annotations

import errno
import logging
import os
import re
import shlex
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from meslam_core import __version__, cli_doctor, cli_map, cli_recording, cli_report, cli_view
from meslam_core.cli_options import (
    CameraOption,
    JsonOption,
    LeverArmOption,
    SetOption,
    TopicOption,
    camera_of,
    topics_of,
)
from meslam_core.command_output import (
    BAD_INPUT,
    INTERRUPTED,
    complain,
    exit_after_run,
    print_entries,
    run_summary,
)
from meslam_core.errors import ConfigError, MeslamError

# Torch and Open3D take seconds to import, so every command imports what it needs itself.

NEXT_STEPS = """\
MeSLAM maps a room with an RGB-D camera and keeps the map in small neural networks.

Try it without a camera, in two minutes:
  meslam simulate room --duration 10 --out room.mcap
  meslam run room.mcap --out out --truth room.truth.txt

A recording of yours (a bag of RealSense or ROS, TUM, folders of images):
  meslam info RECORDING                  what is in it, and whether it can be used
  meslam run RECORDING --out out         track and map it

What came of it:
  meslam view out                        the map in the browser
  meslam report out                      one page of errors, speed and pictures
  meslam mesh out/map.meslam --out room.ply

  meslam doctor                          something does not work? What, and how to mend it
  meslam --install-completion            TAB completes commands and options

`meslam --help` lists all commands, `meslam COMMAND --help` explains one.
"""


class _Commands(TyperGroup):
    """Turns every error that a user can mend into one line and exit status 2."""

    def invoke(self, ctx: Any) -> Any:
        try:
            result = super().invoke(ctx)
            # Service managers may start programs without it.
            if sys.stdout is not None:
                sys.stdout.flush()
            return result
        except MeslamError as error:
            complain(str(error))
            raise typer.Exit(BAD_INPUT) from error
        except OSError as error:
            # Whoever reads what is printed may have gone; that is no one's error.
            if error.errno == errno.EPIPE:
                raise
            _forget_output()
            complain(f"the system refuses: {error}; free what it lacks and try again")
            raise typer.Exit(BAD_INPUT) from error
        except KeyboardInterrupt:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            complain("interrupted; what was not complete is not kept")
            # Python would wait for the threads that compute, and abort when asked once more.
            os._exit(INTERRUPTED)


def _forget_output() -> None:
    """Python would try once more to print at its end, and fail without a word of ours."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


app = typer.Typer(
    cls=_Commands,
    help="Dense RGB-D SLAM whose map is a set of small neural networks.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    invoke_without_command=True,
)


def _presets() -> list[str]:
    from meslam_core.config import PRESETS

    return list(PRESETS)


def main() -> None:
    """Entry point of the `meslam` command."""
    app()


@app.callback()
def _start(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if version:
        typer.echo(f"meslam {__version__}")
    elif context.invoked_subcommand is None:
        typer.echo(NEXT_STEPS, nl=False)
    else:
        _show_warnings()


@app.command()
def run(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING")],
    out: Annotated[Path, typer.Option(help="Folder for the results; made if missing.")],
    camera: CameraOption = None,
    topics: TopicOption = None,
    preset: Annotated[
        str,
        typer.Option(
            help="Settings to start from: default, fine, paper or imap_star.",
            autocompletion=_presets,
        ),
    ] = "default",
    overrides: SetOption = None,
    frames: Annotated[
        str, typer.Option(metavar="A:B[:STEP]", help="Use the frames A, A+STEP, ... below B.")
    ] = ":",
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime",
            help="Offer frames at the recording's pace; those that come while an earlier one is "
            "in work are skipped, but for the newest.",
        ),
    ] = False,
    truth: Annotated[
        Path | None, typer.Option(help="True poses (TUM format) to compare with.")
    ] = None,
    lever_arm: LeverArmOption = False,
    odometry: Annotated[
        Path | None,
        typer.Option(
            metavar="POSES.txt",
            help="Poses of the camera from elsewhere (TUM format, in any frame) instead of the "
            "built-in odometry.",
        ),
    ] = None,
    stored: Annotated[
        Path | None,
        typer.Option("--map", metavar="MAP", help="A stored map to go on with, in its frame."),
    ] = None,
    start_pose: Annotated[
        str,
        typer.Option(
            metavar="'X Y Z QX QY QZ QW'",
            help="Where in that map the first image was taken, to a few centimetres and degrees; "
            "or a TUM file whose first line says it.",
        ),
    ] = "",
    seed: Annotated[int, typer.Option(min=0, help="Of every random choice.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Track and map a recording.

    RECORDING is a rosbag2 folder, an .mcap, .db3 or .bag file, a TUM folder, or a folder with
    color/, depth/ and camera.json. Writes trajectory.txt, trajectory_online.txt with
    covariance_online.txt, map.meslam, frames.csv and report.json; `meslam report` shows them.
    """
    from meslam_core.config import MeslamConfig

    config = MeslamConfig.from_overrides(overrides or [], preset)
    chosen = _frame_range(frames)
    intrinsics = camera_of(camera)
    from meslam_core.console import RunBar, error_console, waiting

    with waiting("loading"):
        from meslam_core.threads import limit_threads

        limit_threads(config.runtime.threads)
        from meslam_core import pipeline
        from meslam_core.continuation import read_continuation
        from meslam_core.recordings import open_recording

        options = pipeline.RunOptions(
            chosen,
            realtime,
            truth,
            hand_eye=lever_arm,
            odometry=odometry,
            continuation=read_continuation(stored, start_pose),
            seed=seed,
            command=shlex.join(["meslam", *sys.argv[1:]]),
        )
        source = open_recording(recording, intrinsics, topics_of(topics))
    try:
        with RunBar(error_console()) as bar:
            outcome = pipeline.run(source, config, out, options, bar)
    finally:
        source.close()
    print_entries(outcome.report, as_json, run_summary(outcome.report, out))
    exit_after_run(outcome, out)


@app.command()
def evaluate(
    trajectory: Annotated[Path, typer.Argument(metavar="TRAJECTORY.txt")],
    truth: Annotated[Path, typer.Argument(metavar="POSES.txt")],
    lever_arm: LeverArmOption = False,
    tolerance: Annotated[
        float, typer.Option(min=0.0, help="Largest difference of paired stamps [s].")
    ] = 0.02,
    as_json: JsonOption = False,
) -> None:
    """Compare a trajectory with true poses, both in TUM format.

    As the TUM benchmark does: paired by stamp, aligned by a rigid motion, RMSE of the rest.
    """
    from meslam_core.console import waiting

    with waiting("comparing"):
        from meslam_core.evaluation.report import trajectory_entries
        from meslam_core.trajectory import read_tum

        entries = trajectory_entries(
            read_tum(trajectory), read_tum(truth), tolerance_s=tolerance, hand_eye=lever_arm
        )
    print_entries(entries, as_json)


app.add_typer(cli_map.app)
app.add_typer(cli_recording.app)
app.add_typer(cli_report.app)
app.add_typer(cli_view.app)
app.add_typer(cli_doctor.app)


def _frame_range(text: str) -> slice:
    number = r"\d{0,18}"
    match = re.fullmatch(rf"({number}):({number})(?::(\d{number}))?", text.strip())
    if match is None:
        raise ConfigError(f"--frames {text!r} is not of the form A:B or A:B:STEP, as in 0:100:2")
    start, stop, step = (int(part) if part else None for part in match.groups())
    if step == 0 or (stop is not None and stop <= (start or 0)):
        raise ConfigError(f"--frames {text!r} chooses nothing; A must be below B and STEP positive")
    return slice(start, stop, step)


def _show_warnings() -> None:
    from meslam_core.console import ConsoleHandler

    package = logging.getLogger("meslam_core")
    package.handlers = [ConsoleHandler()]
    package.propagate = False
