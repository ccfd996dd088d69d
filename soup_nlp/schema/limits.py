"""Limits of input sizes: larger inputs are of no use and would take all memory or time."""

from soup_nlp.errors import DataError

MAX_SIDE = 20_000
"""Largest width or height of an image, flow or depth, pixels."""
MAX_PIXELS = 64_000_000
"""Most pixels of an image; an 8K picture has half as many."""
MAX_ASPECT = 32
"""Largest ratio of the sides of an image; that of a panorama is up to 10."""
MAX_SUPERPIXELS = 20_000
MAX_NEIGHBOURS = 100
MAX_PARTICLES = 1_000
MAX_SAMPLES = 10_000
"""Most pixels or boundary points that are sampled of a superpixel."""
MAX_ROUNDS = 10_000
"""Most rounds or iterations of a loop."""
MAX_SEED = 2**31 - 1
"""OpenCV's random generator takes signed integers of 32 bits."""
LEAST, MOST = 1e-9, 1e9
"""Magnitude of real numbers: products and squares of them stay far from overflow."""


def check_image_size(width: int, height: int, what: str, where: object) -> None:
    """Raise DataError unless an image of `width` x `height` pixels is within the limits.

    `what` and `where` name the image and its file or array in the message.
    """
    size = f"{width} x {height} (width x height)"
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise DataError(
            f"{what} has an impossible size",
            where=where,
            found=size,
            expected=f"1 to {MAX_SIDE} on each side, at most {MAX_PIXELS} pixels",
            hint="scale the images and their intrinsics down; or the file is damaged",
        )
    if max(width, height) > MAX_ASPECT * min(width, height):
        raise DataError(
            f"{what} is too long for its width",
            where=where,
            found=size,
            expected=f"sides of a ratio from 1 to {MAX_ASPECT}",
        )
