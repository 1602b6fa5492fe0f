import numpy as np
import pytest

from optshape_graph import InputError, SensorModel
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.io import load_target
from optshape_graph.io.recordings import Recording, extract_session
from tests.io.recordings.writing import maker, points, write_bag

cv2 = pytest.importorskip("cv2")
T0 = 100.0
ROS = ("ros1", "mcap")


def picture() -> np.ndarray:
    """(48, 64, 3) smooth, so that a Bayer mosaic and JPEG keep it."""
    v, u = np.mgrid[0:48, 0:64]
    return np.dstack([40 + 2 * u, 200 - 2 * v, 60 + u + v]).astype(np.uint8)


def mosaic(bgr: np.ndarray, pattern: str) -> np.ndarray:
    """What a sensor with that pattern (row by row from the top left) sees."""
    channel = {"b": 0, "g": 1, "r": 2}
    rows, columns = np.mgrid[0 : bgr.shape[0], 0 : bgr.shape[1]]
    index = np.array([channel[letter] for letter in pattern])[(rows % 2) * 2 + columns % 2]
    return np.take_along_axis(bgr, index[:, :, None], axis=2)[:, :, 0]


@pytest.mark.parametrize("storage", ROS)
@pytest.mark.parametrize("padding", [0, 5])
def test_encodings(tmp_path, storage, padding):
    make, bgr = maker(storage), picture()
    opaque = np.dstack([bgr, np.full(bgr.shape[:2], 255, np.uint8)])
    exact = {
        "mono8": bgr[:, :, 0], "8UC1": bgr[:, :, 0], "bgr8": bgr, "8UC3": bgr, "rgb8": bgr[:, :, ::-1],
        "bgra8": opaque, "rgba8": opaque[:, :, [2, 1, 0, 3]],
    }  # fmt: skip
    bayer = {f"bayer_{p}8": mosaic(bgr, p) for p in ("rggb", "bggr", "gbrg", "grbg")}
    sent = exact | bayer
    items = [("/image", make.image(T0 + k, rows, name, padding)) for k, (name, rows) in enumerate(sent.items())]
    stream = Recording(write_bag(tmp_path, storage, items)).images()
    images = list(stream)
    assert not stream.skipped
    for name, image in zip(sent, images, strict=True):
        pixels = image.value.pixels()
        if name in exact:
            assert np.array_equal(pixels, bgr[:, :, 0] if pixels.ndim == 2 else bgr)
        else:  # bilinear interpolation of a linear picture: exact but for rounding and the border
            assert np.abs(pixels.astype(int) - bgr)[2:-2, 2:-2].max() <= 1


@pytest.mark.parametrize("storage", ROS)
def test_compressed_images_are_told_by_their_bytes(tmp_path, storage):
    make, bgr = maker(storage), picture()
    jpeg = bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 98])[1])
    png = bytes(cv2.imencode(".png", bgr)[1])
    items = [("/image/compressed", make.compressed(T0 + k, data, "jpeg")) for k, data in enumerate((jpeg, png))]
    found = [image.value for image in Recording(write_bag(tmp_path, storage, items)).images()]
    assert [image.suffix for image in found] == [".jpg", ".png"]
    assert np.abs(found[0].pixels().astype(int) - bgr).max() <= 6  # JPEG of quality 98
    assert np.array_equal(found[1].pixels(), bgr)


def test_bad_images_are_skipped(tmp_path):
    make, grey = maker("mcap"), picture()[:, :, 0]
    short, deep, flat = (make.image(T0 + k, grey, "mono8") for k in range(3))
    short.data = short.data[:-65]
    deep.encoding = "32FC1"
    flat.height = 0
    items = [("/image", short), ("/image", deep), ("/image", flat), ("/image", make.image(T0 + 3, grey, "mono8"))]
    stream = Recording(write_bag(tmp_path, "mcap", items)).images()
    assert [image.stamp for image in stream] == [T0 + 3]
    assert stream.skipped == {"truncated": 1, "image encoding that is not read": 1, "empty": 1}


def test_bytes_that_are_no_image_are_skipped(tmp_path):
    make = maker("mcap")
    stream = Recording(write_bag(tmp_path, "mcap", [("/image", make.compressed(T0, b"GIF89a"))])).images()
    assert list(stream) == []
    assert stream.skipped == {"undecodable image": 1}


K = np.array([[500.0, 0, 320], [0, 501.0, 240], [0, 0, 1]])


@pytest.mark.parametrize("storage", ROS)
@pytest.mark.parametrize(
    ("published", "model", "D"),
    [
        ("plumb_bob", "pinhole", [-0.1, 0.01, 1e-3, 2e-3, 0.0]),
        ("rational_polynomial", "pinhole", [0.1, 0.2, 0, 0, 0.3, 0.4, 0.5, 0.6]),
        ("equidistant", "equidistant", [-0.05, 0.01, 0.02, -0.003]),
        ("equidistant", "equidistant", [-0.05, 0.01, 0.02, -0.003, 0.0]),
    ],
)
def test_camera_parameters(tmp_path, storage, published, model, D):
    make = maker(storage)
    info = make.camera_info(T0, K, np.array(D, float), published)
    image = make.image(T0, picture(), "bgr8")
    items = [("/cam/image_raw", image), ("/cam/camera_info", info), ("/other/camera_info", info)]
    recording = Recording(write_bag(tmp_path, storage, items))
    camera = recording.camera_of("/cam/image_raw")
    assert (camera.model, camera.width, camera.height) == (model, 640, 480)
    assert np.array_equal(camera.K, K)
    assert np.array_equal(camera.D, D[:4] if model == "equidistant" else D)
    assert np.array_equal(recording.camera_of("/cam/image_raw/compressed").K, K)
    with pytest.raises(InputError, match="are rectified"):
        recording.camera_of("/cam/image_rect_color")
    with pytest.raises(InputError, match="several topics of camera parameters"):
        recording.camera_of("/third/image_raw")


def test_a_camera_that_is_not_calibrated_is_said(tmp_path):
    info = maker("mcap").camera_info(T0, np.zeros((3, 3)), np.zeros(5), "plumb_bob")
    recording = Recording(write_bag(tmp_path, "mcap", [("/cam/camera_info", info)]))
    with pytest.raises(InputError, match="no usable camera parameters; 1 x camera not calibrated"):
        recording.camera_of("/cam/image_raw")


@pytest.mark.parametrize("storage", ROS)
def test_encodings_of_16_bits_and_of_brightness_and_colour(tmp_path, storage):
    make, bgr = maker(storage), picture()
    grey = bgr[:, :, 0]
    twelve = grey.astype(np.uint16) << 4  # a camera of 12 bits; its brightest pixel uses them all
    twelve[0, 0] = 4095
    yuv = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV_I420)  # brightness, then u, then v, each of a quarter
    y, u, v = yuv[:48], yuv[48:60].reshape(24, 32), yuv[60:72].reshape(24, 32)
    nv12 = np.vstack([y, np.dstack([u, v]).reshape(24, 64)])
    both = np.repeat(np.dstack([u, v])[:, :, None], 1, axis=2)
    uyvy = np.zeros((48, 64, 2), np.uint8)
    uyvy[:, :, 1] = y
    uyvy[:, 0::2, 0], uyvy[:, 1::2, 0] = np.repeat(both[:, :, 0, 0], 2, axis=0), np.repeat(both[:, :, 0, 1], 2, axis=0)
    sixteen = dict.fromkeys(("mono16", "16UC1"), twelve)
    sixteen |= {f"bayer_{p}16": mosaic(bgr, p).astype(np.uint16) << 8 for p in ("rggb", "bggr", "gbrg", "grbg")}
    sixteen |= {"bgr16": bgr.astype(np.uint16) << 8, "rgb16": bgr[:, :, ::-1].astype(np.uint16) << 8}
    sent = {name: rows.view(np.uint8).reshape(48, -1) for name, rows in
            ((n, np.ascontiguousarray(r)) for n, r in sixteen.items())}  # fmt: skip
    items = []
    for k, (name, rows) in enumerate(sent.items()):
        message = make.image(T0 + k, rows, name)
        message.width = 64
        items.append(("/image", message))
    colours = {"nv12": nv12, "nv21": np.vstack([y, np.dstack([v, u]).reshape(24, 64)]),
               "yuv422": uyvy.reshape(48, 128), "uyvy": uyvy.reshape(48, 128),
               "yuv422_yuy2": uyvy[:, :, ::-1].reshape(48, 128), "yuyv": uyvy[:, :, ::-1].reshape(48, 128)}  # fmt: skip
    for name, rows in colours.items():
        message = make.image(T0 + len(items), rows, name)
        message.height, message.width = 48, 64
        items.append(("/image", message))
    stream = Recording(write_bag(tmp_path, storage, items)).images()
    found = list(stream)
    assert not stream.skipped
    for name, image in zip((*sent, *colours), found, strict=True):
        pixels = image.value.pixels().astype(int)
        assert pixels.shape[:2] == (48, 64)
        if name in ("mono16", "16UC1"):
            assert np.array_equal(pixels[1:], grey[1:])
        elif name.startswith("bayer"):
            assert np.abs(pixels - bgr)[2:-2, 2:-2].max() <= 2
        elif name in sent:
            assert np.array_equal(pixels, bgr)
        else:  # colours of four pixels are one, and rounded twice
            assert np.abs(pixels - bgr).max() <= 10


def test_large_bytes_first(tmp_path):
    make, grey = maker("mcap"), picture()[:, :, 0]
    message = make.image(T0, (grey.astype(">u2") << 8).astype(">u2").view(np.uint8).reshape(48, -1), "mono16")
    message.width, message.is_bigendian = 64, 1
    image = next(iter(Recording(write_bag(tmp_path, "mcap", [("/image", message)])).images()))
    assert np.array_equal(image.value.pixels(), grey)


def test_a_session_without_a_usable_image_says_why(tmp_path):
    make = maker("mcap")
    depth = make.image(T0, picture()[:, :, 0], "mono8")
    depth.encoding = "32FC1"
    items = [("/points", make.cloud(T0, points("velodyne", n=64))), ("/image", depth)]
    recording = Recording(write_bag(tmp_path, "mcap", items))
    camera = CameraIntrinsics("c", "pinhole", 64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]))
    with pytest.raises(InputError, match=r"/image: no usable image: 1 x image encoding that is not read \('32FC1'"):
        extract_session(
            recording, tmp_path / "s", sensor=SensorModel(np.radians([-6.0, -2, 2, 6])),
            targets=[load_target("paper")], camera=camera,
        )  # fmt: skip
