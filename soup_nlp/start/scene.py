"""The static scene among the components: the largest one, or what it stands on.

In a traffic jam a group of vehicles may be larger than the road. The road is then known by what
stands on it, and by its level ground.
"""

import numpy as np

from soup_nlp.arrays import Int, Mask
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.components import numbered
from soup_nlp.start.ground import ground
from soup_nlp.start.views import FlowFit


def scene_first(flow: FlowFit, soup: Soup, reliable: Mask, label: Int, fixed: Mask) -> Int:
    """(N,) indices of the components (N,), that of the static scene first, see `SCENE`.

    The scene is the largest component. In a traffic jam that may be a group of vehicles: if it
    stands on a component with a level ground that stands on nothing, that one is the scene.

    Args:
        flow: The flow of every superpixel.
        soup: Planes, every motion in its own scale.
        reliable: (N,) True where the depth is reliable.
        label: (N,) index of the component.
        fixed: (N,) True in components that are fixed in the image.
    """
    scene, image = int(np.argmax(np.bincount(label, ~fixed))), label[flow.seg.labels]
    below = stands_on(image, scene)
    own = reliable & ~fixed & (label == below)
    mu = 1 / soup.depth_at(flow.views.anchor)
    if own.any() and stands_on(image, below) < 0 and ground(flow, mu, own).any():
        scene = below
    return numbered(np.where(label == scene, -1, label))


def stands_on(image: Int, component: int) -> int:
    """The component below the lower end of another one on most of its width; -1 for the border.

    Args:
        image: (H, W) component of every pixel.
        component: Index of the one that stands on it.
    """
    mine = image == component
    seen, under = mine.any(axis=0), len(image) - np.argmax(mine[::-1], axis=0)
    border = seen & (under == len(image))
    columns = np.flatnonzero(seen & ~border)
    count = np.bincount(image[under[columns], columns], minlength=1)
    return -1 if border.sum() >= count.max() else int(np.argmax(count))
