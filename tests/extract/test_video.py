"""Video in and out: real time stamps, turned pictures, and files that are not whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from vid2demo.extract.errors import UserError
from vid2demo.extract.video import VideoWriter, iterate_frames, read_video_info

SHARED = Path(__file__).parents[2].parent / "shared"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/data")


def write_clip(path: Path, times_s: list[float], size: tuple[int, int] = (120, 160)) -> Path:
    with VideoWriter(path, 25.0) as writer:
        for k, time_s in enumerate(times_s):
            image = np.full((*size, 3), 40, np.uint8)
            image[:20, :20] = 10 * k  # top left corner tells the frame
            image[-30:, -30:, 0] = 250  # bottom right corner is red
            writer.write(image, time_s)
    return path


def test_variable_frame_rate_comes_back_as_written(tmp_path: Path) -> None:
    times_s = [0.0, 0.04, 0.10, 0.11, 0.30, 0.34]
    clip = write_clip(tmp_path / "a.mp4", times_s)
    info = read_video_info(clip)
    frames = list(iterate_frames(clip))
    assert info.time_s == pytest.approx(times_s, abs=1e-4)
    assert [f.time_s for f in frames] == pytest.approx(times_s, abs=1e-4)
    assert [round(float(f.rgb[5:10, 5:10].mean()) / 10) for f in frames] == list(range(6))
    assert (info.width_px, info.height_px) == (160, 120)


def test_frames_can_be_read_smaller(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "a.mp4", [0.0, 0.04])
    assert next(iterate_frames(clip, 80)).rgb.shape == (60, 80, 3)
    assert next(iterate_frames(clip, 1000)).rgb.shape == (120, 160, 3)


def test_rotation_flag_is_applied(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "a.mp4", [0.0, 0.04, 0.08])
    data = bytearray(clip.read_bytes())
    # The display matrix of the track header: from the identity to a quarter turn, as phones write it.
    one, minus = (1 << 16).to_bytes(4, "big"), (-(1 << 16) & 0xFFFFFFFF).to_bytes(4, "big")
    zero, last = bytes(4), (1 << 30).to_bytes(4, "big")
    identity = one + zero * 3 + one + zero * 3 + last
    at = data.index(identity, data.index(b"tkhd"))
    data[at : at + 36] = zero + one + zero + minus + zero * 4 + last
    turned = tmp_path / "turned.mp4"
    turned.write_bytes(data)
    info = read_video_info(turned)
    assert (info.width_px, info.height_px) == (120, 160)
    frame = next(iterate_frames(turned)).rgb
    # A quarter turn clockwise takes the bottom right corner to the bottom left.
    assert frame[-10:, :10, 0].mean() > 180
    assert frame[-10:, -10:, 0].mean() < 100


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: p, "does not exist"),
        (lambda p: p.write_bytes(b""), "is empty"),
        (lambda p: p.write_bytes(b"not a video" * 100), "cannot be read as a video"),
    ],
)
def test_what_is_not_a_video_is_one_clear_error(tmp_path: Path, make, words: str) -> None:
    path = tmp_path / "x.mp4"
    make(path)
    with pytest.raises(UserError, match=words):
        read_video_info(path)


def test_sound_alone_is_not_a_video(tmp_path: Path) -> None:
    import av

    path = tmp_path / "sound.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate, frame.pts = 44100, 0
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(UserError, match="no video stream"):
        read_video_info(path)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_truncated_file_is_refused_before_the_first_frame(tmp_path: Path, share: float) -> None:
    rng = np.random.default_rng(0)
    clip = tmp_path / "a.mp4"
    with VideoWriter(clip, 25.0) as writer:
        for _ in range(60):
            writer.write(rng.integers(0, 255, (120, 160, 3), dtype=np.uint8))
    data = clip.read_bytes()
    short = tmp_path / "short.mp4"
    short.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(UserError, match="truncated"):
        next(iterate_frames(short))


def test_writer_leaves_nothing_when_interrupted(tmp_path: Path) -> None:
    def interrupted() -> None:
        with VideoWriter(tmp_path / "a.mp4", 25.0) as writer:
            writer.write(np.zeros((64, 64, 3), np.uint8))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


@needs_shared
def test_frames_that_the_decoder_hands_out_of_order_are_put_right() -> None:
    # box_turn.mp4 was cut from a longer recording: one broken frame, and a wrong reorder depth.
    times = [f.time_s for f in iterate_frames(SHARED / "data/videos/box_turn.mp4", 64)]
    assert len(times) == 455
    assert np.all(np.diff(times) > 0)
