"""Frames of a sequence: files, videos and scenes; which of them are refused or left out."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_files import photo
from helpers_odd_world import png
from PIL import Image

from soup_nlp.errors import DataError
from soup_nlp.report.figures import write_png
from soup_nlp.sequence import solve as solving
from soup_nlp.sequence.frames import (
    Frames,
    find_depths,
    find_images,
    in_order,
    is_video,
    video_frames,
)
from soup_nlp.storage.folders import staged

pytestmark = pytest.mark.slow

IMAGE = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)


def test_pictures_of_no_sequence_are_refused(tmp_path, refused):
    rng = np.random.default_rng(1)
    for k, size in enumerate(((48, 64), (48, 64), (40, 64))):
        write_png(tmp_path / f"{k}.png", rng.integers(0, 256, (*size, 3)).astype(np.uint8))
    out = "-o", tmp_path / "out"
    assert "differ in size: are they one sequence?" in refused("chain", tmp_path, *out)
    photo(tmp_path / "2.jpg", IMAGE, turned=6)
    # files that are named, too; the size is that of the picture as it is shown
    for name, size in (("2.png", "64x40"), ("2.jpg", "48x64")):
        images = [tmp_path / x for x in ("0.png", "1.png", name)]
        assert f"found: 0.png 64x48, {name} {size}" in refused("chain", *images, *out)
    assert not (tmp_path / "out").exists()


def make_video(path, count):
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for k in range(count):
        video.write(np.full((48, 64, 3), 50 * k, np.uint8))
    video.release()


def test_frames_of_a_folder_a_pattern_and_a_video(tmp_path):
    for k in (10, 9, 100):
        write_png(tmp_path / f"frame_{k}.png", IMAGE)
        np.save(tmp_path / f"depth_{k}.npy", np.ones((48, 64)))
    write_png(tmp_path / "other.png", IMAGE)
    images = find_images(tmp_path)
    assert [p.name for p in images] == ["frame_9.png", "frame_10.png", "frame_100.png"]
    assert find_images(tmp_path / "frame_1*.png") == images[1:]
    depths = find_depths(images)
    assert [p.name for p in depths] == ["depth_9.npy", "depth_10.npy", "depth_100.npy"]
    (tmp_path / "depth_9.npy").unlink()
    assert find_depths(images) == []
    own = Frames(tuple(map(str, images)), {"fov": 60}, depths, 256.0).pair(1)
    assert own["next"] == str(images[2])
    assert own["depth_next"] == str(depths[2])
    assert Frames(("a",) * 4, scene="street").pair(2)["frame"] == 2
    with pytest.raises(DataError, match="two images"):
        find_images(tmp_path / "*.jpg")
    make_video(tmp_path / "a.avi", 5)
    found = video_frames(tmp_path / "a.avi", tmp_path / "frames", stride=2)
    levels = [cv2.imread(str(p)).mean() for p in found]
    np.testing.assert_allclose(levels, [0, 100, 200], atol=3)
    whole = (tmp_path / "a.avi").read_bytes()
    for content, match in ((b"text", "neither"), (b"RIFF\0", "fewer"), (whole[:6000], "fewer")):
        (tmp_path / "b.mp4").write_bytes(content)
        with pytest.raises(DataError, match=rf"{match}[\s\S]*expected: [\s\S]*try: "):
            video_frames(tmp_path / "b.mp4", tmp_path / "frames2")


@pytest.mark.parametrize(
    "name", ["10:05:07.mp4", "00001.MTS", "a.ts", "clip", "file:a.3gp", "a.gif"]
)
def test_any_file_that_is_no_image_is_read_as_a_video(name, tmp_path, monkeypatch):
    make_video(tmp_path / "a.avi", 3)
    (tmp_path / "a.avi").rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert is_video(Path(name))
    assert len(video_frames(Path(name), tmp_path / "frames")) == 3


def test_frames_of_a_gif_need_no_duration(tmp_path):
    first, *others = (Image.new("RGB", (64, 48), (50 * k, 0, 0)) for k in range(5))
    first.save(tmp_path / "a.gif", save_all=True, append_images=others)
    found = video_frames(tmp_path / "a.gif", tmp_path / "frames", stride=2)
    reds = [cv2.imread(str(path))[0, 0].tolist() for path in found]
    assert reds == [[0, 0, red] for red in (0, 100, 200)]
    assert len(video_frames(tmp_path / "a.gif", tmp_path / "two", most=2)) == 2


@pytest.mark.parametrize(
    "names",
    [
        ["05", "99", "100"],
        ["9.05", "9.50", "10.00"],
        ["9.8", "9.9", "10.1", "10.5"],
        ["1305031102.175304", "1305031102.211214", "1305031103.043227"],
    ],
)
def test_files_have_the_order_of_their_numbers(names, tmp_path):
    paths = [tmp_path / "v1.10" / f"{name}.png" for name in names]
    assert in_order(paths[::-1]) == paths


@pytest.mark.parametrize("names", [["cam0.8", "cam0.9", "cam0.10"], ["9", "9.25", "9.5", "10"]])
def test_decimals_that_may_be_two_numbers_are_refused(names, tmp_path):
    with pytest.raises(DataError, match=f"not clear[\\s\\S]*{names[0]}.png"):
        in_order([tmp_path / f"{name}.png" for name in names])


@pytest.mark.parametrize(
    ("names", "ordered"),
    [
        (["IMG_1.jpg", "._IMG_1.jpg", "IMG_2.jpg", ".x.png"], ["IMG_1.jpg", "IMG_2.jpg"]),
        (["x.jpg", "x.dng", "y.jpg", "y.DNG"], ["x.jpg", "y.jpg"]),
        (["x.dng", "y.DNG"], ["x.dng", "y.DNG"]),
        (
            ["t1305031102175304321.png", "t1305031102175304320.png"],
            ["t1305031102175304320.png", "t1305031102175304321.png"],
        ),
    ],
)
def test_files_of_a_folder_that_are_frames(names, ordered, tmp_path):
    for name in names:
        write_png(tmp_path / "image.png", IMAGE)
        (tmp_path / "image.png").rename(tmp_path / name)
    for source in (tmp_path, tmp_path / "*"):
        assert [p.name for p in find_images(source)] == ordered


@pytest.mark.parametrize(
    ("name", "make", "said"),
    [
        ("3.png", lambda path: path.write_bytes(png(64, 48)), "truncated"),
        ("3.heic", lambda path: path.write_bytes(b"\0\0\0\x18ftypheic" + bytes(100)), "convert it"),
        ("3.png", lambda path: photo(path, IMAGE, turned=6), "turned"),
        # its hash would wait for a writer for ever
        ("K.txt", os.mkfifo, "a pipe, socket or device"),
    ],
)
def test_an_unreadable_file_is_found_before_the_first_solve(
    name, make, said, tmp_path, refused, monkeypatch
):
    monkeypatch.setattr(solving.stored, "solve_into", None)
    for k in range(3):
        write_png(tmp_path / f"{k}.png", IMAGE)
    make(tmp_path / name)
    camera = [] if name == "K.txt" else ["--intrinsics", "60,60,31.5,23.5"]
    error = refused("chain", tmp_path, *camera, "-o", tmp_path / "out")
    assert name in error
    assert said in error
    assert not (tmp_path / "out").exists()


def test_frames_of_another_sequence_are_left_alone(tmp_path, refused):
    out = tmp_path / "out"
    with staged(out, subject="another sequence") as new:
        (new / "chain.json").write_text("{}")
    with staged(out / "frames") as new:
        write_png(new / "0000.png", IMAGE)
    before = (out / "frames" / "0000.png").read_bytes()
    make_video(tmp_path / "clip.avi", 3)
    assert "something else" in refused("chain", tmp_path / "clip.avi", "-o", out)
    assert (out / "frames" / "0000.png").read_bytes() == before


def test_a_pattern_may_match_folders(tmp_path):
    for name in ("10", "9", ".hidden", "[9]"):
        (tmp_path / name).mkdir()
        write_png(tmp_path / name / "x.png", IMAGE)
        write_png(tmp_path / name / "z.png", IMAGE)
    found = find_images(tmp_path / "*" / "x.png")
    assert [p.parent.name for p in found] == ["9", "10", "[9]"]
    # brackets in the name of a folder that exists are no pattern
    assert [p.name for p in find_images(tmp_path / "[9]" / "*.png")] == ["x.png", "z.png"]
