"""
Make videos of a policy: the environment's pictures, with the task-relevant variables (TRVs) or the actions over time
below.

Dimension key: T time steps of an episode, Z TRVs.
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from sb3_tdpg.common.files import replaced_atomically
from sb3_tdpg.evaluation.figures import INK, PALETTE, import_matplotlib, tidy

MIN_WIDTH = 400  # pixels: smaller pictures are enlarged, so that the labels of the plot fit below
# The resolution, the height and the margins, in pixels, are those of a video of width MIN_WIDTH. A wider video has
# larger letters, since a phone shows videos of all widths at the same size.
DPI = 100
PANEL_HEIGHT = 180  # height of the plot of the TRVs
LEFT, RIGHT, TOP, BOTTOM = 62, 76, 26, 42  # margins around the axes; the legend is at the right
SYMBOLS = {"TRV": r"$\tilde{x}_t$", "action": "$u_t$"}
HOLD = 1.0  # s: duration of the last frame of an episode
MAX_LINES = 8  # more TRVs than this are drawn as rows of an image


class Episode(NamedTuple):
    """An episode to show in a video."""

    pictures: Sequence[np.ndarray]  # T + 1 pictures (H, W, 3) uint8, of x_0 ... x_T
    signals: np.ndarray  # (T, Z)
    costs: np.ndarray  # (T,), the last one with the terminal cost
    between: Sequence[Sequence[np.ndarray]] = ()  # pictures between x_t and x_{t+1} for each step, or nothing

    def film(self) -> Iterator[tuple[float, np.ndarray]]:
        """Yield the time in steps and the picture of each frame."""
        for t, picture in enumerate(self.pictures):
            yield float(t), picture
            between = self.between[t] if t < len(self.between) else ()
            for i, seen in enumerate(between, start=1):
                yield t + i / (len(between) + 1), seen


def check_animation_path(path: str | os.PathLike[str]) -> None:
    """Raise an error if the extension is not ``.gif`` or ``.mp4``, or if matplotlib, or ffmpeg for .mp4, is missing."""
    ending = Path(path).suffix
    if ending not in (".gif", ".mp4"):
        raise ValueError(f"{path}: the extension {ending!r} is not a video format: use .gif or .mp4")
    import_matplotlib()
    if ending == ".mp4" and _ffmpeg() is None:
        raise ValueError(f"{path}: an .mp4 needs ffmpeg: install it, pip install imageio-ffmpeg, or use .gif")


def _ffmpeg() -> str | None:
    """
    Return the path of the ffmpeg of Matplotlib's settings (by default, on the PATH), or else of imageio-ffmpeg.

    If there is neither, the result is ``None``.
    """
    import matplotlib as mpl

    if (found := shutil.which(mpl.rcParams["animation.ffmpeg_path"])) is not None:
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        return None


def save_animation(
    episodes: Sequence[Episode], path: str | os.PathLike[str], *, horizon: int, fps: float, signal: str = "TRV"
) -> None:
    """
    Write episodes as a video, one after the other; the last frame of an episode stays for about a second.

    :param episodes: Episodes with pictures of the same size.
    :param path: ``.gif`` or ``.mp4``. Folders are created, and the file appears only when it is complete.
    :param horizon: Number of controls T in an episode.
    :param fps: Frames per second. A GIF rounds the duration of a frame to hundredths of a second, at least two.
    :param signal: ``"TRV"`` or ``"action"``: what is drawn below the pictures.
    :raises ValueError: if the extension is another one, or an ``.mp4`` needs ffmpeg and there is none.
    """
    check_animation_path(path)
    path = Path(path)
    video = _Video(episodes, horizon, signal)
    with replaced_atomically(path) as partial:
        (_write_gif if path.suffix == ".gif" else _write_mp4)(video, partial, fps)


class _Video:
    """The figure of a video, and the parts of it that change from frame to frame."""

    def __init__(self, episodes: Sequence[Episode], horizon: int, signal: str) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.episodes, self._signal = episodes, signal
        height, width = episodes[0].pictures[0].shape[:2]
        self._factor = -(-MIN_WIDTH // width)
        height, width = self._factor * height, self._factor * width
        scale = width / MIN_WIDTH
        panel = round(scale * PANEL_HEIGHT)
        dpi, total = scale * DPI, height + panel
        # A tenth of a pixel is added, because rounding down the size would cut a row off the picture.
        self.figure: Figure = Figure(figsize=((width + 0.1) / dpi, (total + 0.1) / dpi), dpi=dpi)
        self.canvas = FigureCanvasAgg(self.figure)
        # The picture is drawn pixel by pixel, because axes would resample it.
        self._picture = self.figure.figimage(self._enlarged(episodes[0].pictures[0]), xo=0, yo=panel)
        left, right, top, bottom = (scale * margin for margin in (LEFT, RIGHT, TOP, BOTTOM))
        self._axes = axes = self.figure.add_axes((
            left / width, bottom / total, (width - left - right) / width, (panel - top - bottom) / total
        ))  # fmt: skip
        axes.set_xlabel("time step $t$", fontsize=9)
        axes.locator_params(axis="x", integer=True)
        tidy(axes)
        # All frames share the limits of the axes.
        signals = np.concatenate([episode.signals for episode in episodes])
        self._lines: list[Any] = []
        self._rows: Any = None
        if signals.shape[1] <= MAX_LINES:
            self._draw_lines(signals, horizon)
        else:
            self._draw_rows(signals, horizon)
        self._now = axes.axvline(0, color=INK, linewidth=0.8, alpha=0.5)

    def _draw_lines(self, signals: np.ndarray, horizon: int) -> None:
        """Draw a line for each TRV: ``(n, Z)``."""
        axes = self._axes
        low, high = float(signals.min()), float(signals.max())
        margin = 0.05 * (high - low) or 1.0
        axes.set(xlim=(0, horizon), ylim=(low - margin, high + margin))
        axes.grid(alpha=0.25)
        axes.set_ylabel(f"{self._signal}s {SYMBOLS[self._signal]}", fontsize=9)
        looks: dict[str, Any] = dict(linewidth=1.3, marker="o", markersize=2.5, clip_on=False)
        self._lines = [
            axes.plot([], [], label=str(i + 1), color=color, **looks)[0]
            for i, color in zip(range(signals.shape[1]), PALETTE, strict=False)
        ]
        axes.legend(
            title=self._signal, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8,
            title_fontsize=9, handlelength=1.2, labelspacing=0.2,
        )  # fmt: skip

    def _draw_rows(self, signals: np.ndarray, horizon: int) -> None:
        """Draw a row of colours for each TRV: ``(n, Z)``."""
        n_signals = signals.shape[1]
        largest = float(np.abs(signals).max()) or 1.0
        self._rows = self._axes.imshow(
            np.full((n_signals, horizon), np.nan), aspect="auto", interpolation="nearest", cmap="RdBu_r",
            vmin=-largest, vmax=largest, extent=(-0.5, horizon - 0.5, n_signals + 0.5, 0.5),
        )  # fmt: skip
        self._axes.set_xlim(-0.5, horizon + 0.5)  # the last picture shows the end, after the last TRVs
        self._axes.set_ylabel(self._signal, fontsize=9)
        box = self._axes.get_position()
        bar = self.figure.add_axes((box.x1 + 0.012, box.y0, 0.012, box.height))
        self.figure.colorbar(self._rows, cax=bar)
        bar.tick_params(labelsize=8, length=2)
        bar.set_title(SYMBOLS[self._signal], fontsize=9)

    def frames(self) -> Iterator[bool]:
        """Draw each frame in turn, and yield whether it is the last frame of its episode."""
        for number, episode in enumerate(self.episodes, start=1):
            cost_so_far = np.concatenate([[0.0], episode.costs.cumsum()])
            for time, picture in episode.film():
                t = int(time)
                self._picture.set_data(self._enlarged(picture))
                self._now.set_xdata([time, time])
                for line, values in zip(self._lines, episode.signals.T, strict=False):
                    line.set_data(np.arange(len(values))[: t + 1], values[: t + 1])
                if self._rows is not None:
                    shown = np.full(self._rows.get_array().shape, np.nan)
                    shown[:, : min(t + 1, len(episode.signals))] = episode.signals[: t + 1].T
                    self._rows.set_data(shown)
                self._axes.set_title(
                    f"episode {number}, step {t}: cost so far {cost_so_far[t]:.2f}", loc="left", fontsize=9, color=INK
                )
                yield time == len(episode.costs)

    def image(self) -> Image.Image:
        """Return the present frame as an image."""
        self.canvas.draw()
        return Image.fromarray(np.asarray(self.canvas.buffer_rgba())[..., :3])

    def _enlarged(self, picture: np.ndarray) -> np.ndarray:
        return picture.repeat(self._factor, axis=0).repeat(self._factor, axis=1)


def _write_gif(video: _Video, path: Path, fps: float) -> None:
    images, durations = [], []
    for is_last in video.frames():
        images.append(video.image())
        durations.append(1000 * HOLD if is_last else max(20, 10 * round(100 / fps)))  # ms; viewers slow shorter frames
    save_gif(path, images, durations)


def save_gif(
    path: str | os.PathLike[str],
    images: Sequence[Image.Image],
    durations: Sequence[float],
    palette: Image.Image | None = None,
) -> None:
    """
    Write images of equal size as a looping GIF. All images share one palette, because separate palettes flicker.

    :param path: The file; its folder exists.
    :param images: RGB images.
    :param durations: Duration of each image, in ms.
    :param palette: An image with the palette to use; default: 256 colours from at most eight of the images.
    """
    if palette is None:
        # MAXCOVERAGE keeps the colours of small objects, and k-means improves those of large ones.
        sample = np.concatenate([np.asarray(image) for image in images[:: -(-len(images) // 8)]])
        palette = Image.fromarray(sample).quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=1)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    first.save(path, save_all=True, append_images=others, duration=list(durations), loop=0, optimize=True)


def _write_mp4(video: _Video, path: Path, fps: float) -> None:
    import matplotlib as mpl
    from matplotlib.animation import FFMpegWriter

    writer = FFMpegWriter(fps=fps)  # type: ignore[arg-type]  # ffmpeg takes fractions, too
    with mpl.rc_context({"animation.ffmpeg_path": _ffmpeg()}), writer.saving(video.figure, str(path), video.figure.dpi):
        for is_last in video.frames():
            for _ in range(max(1, round(HOLD * fps)) if is_last else 1):
                writer.grab_frame()
