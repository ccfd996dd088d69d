"""What a problem may take as its input, told apart by `kind`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from soup_nlp.config_mirror import Strict

Finite = Annotated[float, Field(allow_inf_nan=False)]
Camera = Annotated[list[Finite], Field(min_length=4, max_length=4)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Index = Annotated[int, Field(ge=0)]
White = Annotated[int, Field(ge=1, le=65535)]
Step = Annotated[int, Field(ge=1)]


class FilesInput(Strict):
    """Two image files and their cameras; the flow file is named under `flow.source`.

    Attributes:
        kind: Kind of input.
        ref: Reference image.
        next: Next image.
        intrinsics: [fx, fy, cx, cy] of the reference frame in pixels, or a file of 4 or 9 numbers.
        intrinsics_next: The same of the next frame; null for the same camera.
        depth: True depth of the reference frame, for measuring only (.dpt .npy .pfm .png).
        depth_next: True depth of the next frame.
        depth_scale: Values per unit of length of a 16-bit .png depth.
        unit: Unit of the true depth.
        white: Value of 16-bit images that is white, 4095 where they hold 12 bits; null for 65535.
    """

    kind: Literal["files"]
    ref: str
    next: str
    intrinsics: Camera | str
    intrinsics_next: Camera | str | None = None
    depth: str | None = None
    depth_next: str | None = None
    depth_scale: Positive = 1000.0
    unit: str = "m"
    white: White | None = None


class FolderInput(Strict):
    """A folder with frame_0, frame_1, K.txt and optional truth.

    Attributes:
        kind: Kind of input.
        path: The folder.
        depth_scale: Values per unit of length of a 16-bit .png depth.
        unit: Unit of the true depth.
        white: Value of 16-bit images that is white, 4095 where they hold 12 bits; null for 65535.
    """

    kind: Literal["folder"]
    path: str
    depth_scale: Positive = 1000.0
    unit: str = "m"
    white: White | None = None


class MotorcycleInput(Strict):
    """The Middlebury motorcycle pair that scikit-image ships.

    Attributes:
        kind: Kind of input.
    """

    kind: Literal["motorcycle"]


class SceneInput(Strict):
    """A rendered dynamic scene with exact truth.

    Attributes:
        kind: Kind of input.
        scene: Which scene.
        seed: Changes layout, textures and motions.
        width: Columns, pixels.
        height: Rows, pixels.
    """

    kind: Literal["scene"]
    scene: Literal["street", "room", "sheet", "orbit", "still"]
    seed: Index = 0
    width: Annotated[int, Field(ge=64)] = 1024
    height: Annotated[int, Field(ge=48)] = 436


class SintelInput(Strict):
    """MPI Sintel, official layout.

    Attributes:
        kind: Kind of input.
        root: Folder that holds training/.
        scene: Such as alley_1.
        frame: Number of the reference frame.
        render: Rendering pass.
        step: Distance of the next frame.
    """

    kind: Literal["sintel"]
    root: str
    scene: str
    frame: Index
    render: Literal["clean", "final", "albedo"] = "clean"
    step: Step = 1


class KittiInput(Strict):
    """KITTI 2012 or 2015, official layout.

    Attributes:
        kind: Kind of input.
        root: Folder that holds training/.
        index: Six digits in quotes, such as "000138".
        occ: Truth with occluded pixels (true) or without.
    """

    kind: Literal["kitti2012", "kitti2015"]
    root: str
    index: str
    occ: bool = True


class VkittiInput(Strict):
    """Virtual KITTI 1 (scene is the world, such as "0001") or 2, official layout.

    Attributes:
        kind: Kind of input.
        root: Root folder of the dataset.
        scene: Such as "0001" (1) or Scene01 (2).
        frame: Number of the reference frame.
        variation: Weather or camera variation.
        step: Distance of the next frame.
    """

    kind: Literal["vkitti1", "vkitti2"]
    root: str
    scene: str
    frame: Index
    variation: str = "clone"
    step: Step = 1


class TumInput(Strict):
    """TUM RGB-D, official layout.

    Attributes:
        kind: Kind of input.
        path: Folder of the sequence.
        frame: Index of the reference image in rgb.txt.
        step: Distance of the next image.
    """

    kind: Literal["tum"]
    path: str
    frame: Index = 0
    step: Step = 1


class MemoryInput(Strict):
    """A pair that was in memory: a problem with it tells runs apart, but cannot be solved again.

    Attributes:
        kind: Kind of input.
        hash: Of the images, cameras and flow.
    """

    kind: Literal["memory"]
    hash: str


Input = Annotated[
    FilesInput
    | FolderInput
    | MotorcycleInput
    | SceneInput
    | SintelInput
    | KittiInput
    | VkittiInput
    | TumInput
    | MemoryInput,
    Field(discriminator="kind"),
]
