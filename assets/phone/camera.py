"""What a phone makes of light: rolling shutter, blur, automatic exposure, noise, sharpening, H.264."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from render_images import srgb
from scipy import ndimage

WIDTH, HEIGHT, FOCAL = 640, 360, 560.0  # [pixels]
BRIGHTNESS = 0.20  # mean of linear light that the exposure aims at
LAG = 0.35  # time in which the exposure follows [s]
VIGNETTE = 0.22  # light lost in the corners
FULL = 2000.0  # electrons of a white pixel in a phone's short exposure
READ = 8.0  # electrons of noise in the dark


@dataclass(frozen=True)
class Exposure:
    """When pixels see.

    Attributes:
        shutter: How long a row is exposed [s].
        readout: How much later the last row is exposed than the first [s].
    """

    shutter: float
    readout: float

    def span(self, time: float, rows: tuple[int, int] = (0, HEIGHT)) -> tuple[float, float]:
        """From when to when rows of a frame see, whose time is the middle of its middle row."""
        first, last = (time + (row / HEIGHT - 0.5) * self.readout for row in rows)
        return first - 0.5 * self.shutter, last + 0.5 * self.shutter

    def moments(self, time: float, rows: tuple[int, int], count: int) -> tuple[np.ndarray, np.ndarray]:
        """Moments of a frame [s], shape (count,), and their weights in its rows, shape (count, rows)."""
        start, end = self.span(time, rows)
        edges = np.linspace(start, end, count + 1)
        middle = time + ((np.arange(*rows) + 0.5) / HEIGHT - 0.5) * self.readout
        from_, to = middle - 0.5 * self.shutter, middle + 0.5 * self.shutter
        weights = np.minimum(edges[1:, None], to) - np.maximum(edges[:-1, None], from_)
        weights = np.maximum(weights, 0.0)
        return 0.5 * (edges[1:] + edges[:-1]), weights / weights.sum(axis=0)


class Sensor:
    """Light to pixels, frame after frame: the exposure follows what it sees.

    Args:
        rate: Frames/s.
        noise: Standard deviation relative to that of a usual phone.
        off: Factor by which the exposure is wrong at the start.
        sharpened: Share of the difference from a blurred picture that is added.
        seed: Of the noise.
    """

    def __init__(self, rate: float, noise: float, off: float, sharpened: float, seed: int):
        self._lag = 1 - np.exp(-1 / (rate * LAG))
        self._noise, self._sharpened = noise, sharpened
        self._off: float | None = off
        self._gain = 0.0
        self._random = np.random.default_rng(seed)

    def __call__(self, light: np.ndarray) -> np.ndarray:
        """Picture in sRGB, 0 to 1, of linear light."""
        rows, columns = np.mgrid[: light.shape[0], : light.shape[1]]
        aside = np.hypot(rows - 0.5 * light.shape[0], columns - 0.5 * light.shape[1])
        seen = light * (1 - VIGNETTE * (aside / aside.max()) ** 2)[..., None]
        wanted = BRIGHTNESS / seen.mean()
        if self._off is not None:
            self._gain, self._off = wanted * self._off, None
        self._gain *= (wanted / self._gain) ** self._lag
        electrons = FULL * np.clip(seen * self._gain, 0, 1.5)
        spread = self._noise * np.sqrt(electrons + READ**2)
        noisy = (electrons + spread * self._random.standard_normal(electrons.shape)) / FULL
        picture = srgb(noisy)
        smooth = ndimage.gaussian_filter(picture, (1.0, 1.0, 0.0))
        return np.clip(picture + self._sharpened * (picture - smooth), 0, 1)

    @property
    def gain(self) -> float:
        """Of the last picture."""
        return self._gain


def encode(folder: Path, rate: int, crf: int) -> None:
    """Put the frames into a film with H.264 of a quality (18: hardly seen, 30: seen)."""
    import av
    from PIL import Image

    with av.open(str(folder / "film.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"crf": str(crf), "preset": "fast"}
        for file in sorted((folder / "frames").glob("*.png")):
            with Image.open(file) as picture:
                frame = av.VideoFrame.from_ndarray(np.asarray(picture.convert("RGB")), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
