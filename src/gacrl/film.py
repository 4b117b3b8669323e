"""Episodes as a file to look at, of the kind that its name says: PNG, GIF, or MP4 where ffmpeg is at hand."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from importlib import import_module
from itertools import chain
from pathlib import Path

from gacrl import reel
from gacrl.errors import UserError
from gacrl.evaluation.episodes import Episode
from gacrl.reel import Beside
from gacrl.render import WORDS
from gacrl.replacing import replaced
from gacrl.tasks.task import Words

_FPS = 10


def require_format(path: Path) -> None:
    """Raise UserError, with one sentence, for a name that ends in no format that can be written here."""
    kind = path.suffix.lower()
    if kind not in (".png", ".gif", ".mp4"):
        what = f"cannot write {kind[1:].upper()}" if kind else "its name does not say what to write"
        raise UserError(f"{path}: {what}; --out must end in .png, .gif or, with ffmpeg installed, in .mp4")
    if kind == ".mp4" and _ffmpeg() is None:
        raise UserError(
            f"{path}: MP4 needs ffmpeg, and there is none on the PATH: install it, or let --out end in .gif"
        )


def write(
    episodes: Sequence[Episode],
    path: Path,
    size: int = 480,
    title: str = "",
    words: Words = WORDS,
    beside: Beside | None = None,
) -> None:
    """Write the episodes, one after the other, in the format that the path ends in; see `reel.gif`, `reel.strip`.

    Raises UserError where that cannot be, OSError where the file cannot be written.
    """
    require_format(path)
    kind = path.suffix.lower()
    if kind == ".png":
        require_rows(path, len(episodes), beside is not None)
        reel.strip(episodes, path, size, title, words, beside)
    elif kind == ".gif":
        reel.gif(episodes, path, size, _FPS, title, words, beside)
    else:
        _mp4(episodes, path, size, title, words, beside)


def require_rows(path: Path, episodes: int, beside: bool) -> None:
    """Raise UserError for a strip of too many episodes; films have as many as they like."""
    most = reel.MOST_ROWS // (1 + beside)
    if path.suffix.lower() == ".png" and episodes > most:
        raise UserError(f"{path}: a strip shows at most {most} episodes so, not {episodes}; say --episodes {most}")


def _mp4(
    episodes: Sequence[Episode], path: Path, size: int, title: str, words: Words, beside: Beside | None
) -> None:
    """Pipe the frames to ffmpeg; one that is seen for longer is sent several times."""
    times = [max(1, round(pause * _FPS / 1000)) for pause in reel.durations(episodes, _FPS, beside)]
    frames = reel.drawn(episodes, size, title, words, 1, beside)
    first = next(frames)
    with replaced(path) as file, tempfile.TemporaryFile() as said:
        command = [
            *(str(_ffmpeg()), "-loglevel", "error", "-y"),
            *(
                "-f",
                "rawvideo",
                "-pix_fmt",
                "rgb24",
                "-s",
                f"{first.width}x{first.height}",
                "-r",
                str(_FPS),
                "-i",
                "-",
            ),
            *(
                "-vf",
                "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white",
                "-pix_fmt",
                "yuv420p",
                "-movflags",
                "+faststart",
            ),
            *("-f", "mp4", f"file:{os.path.abspath(file.name)}"),  # noqa: PTH100 a name with a colon is no address
        ]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=said, stderr=said) as ffmpeg:
            assert ffmpeg.stdin is not None
            try:
                for picture, count in zip(chain([first], frames), times, strict=True):
                    for _ in range(count):
                        ffmpeg.stdin.write(picture.tobytes())
                ffmpeg.stdin.close()
            except BrokenPipeError:
                pass  # it has ended, and says why
        if ffmpeg.returncode:
            said.seek(0)
            why = said.read().decode(errors="replace").strip().splitlines()
            raise UserError(
                f"ffmpeg could not write {path}: {why[-1] if why else f'it ended with {ffmpeg.returncode}'}"
            )


def _ffmpeg() -> str | None:
    """The program: on the PATH, or the one that the package imageio-ffmpeg brings; None where there is none."""
    found = shutil.which("ffmpeg")
    if found is not None:
        return found
    try:
        return import_module("imageio_ffmpeg").get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        return None
