import json
from pathlib import Path

import numpy as np
import pytest
from vision.photographs import capture, directions, pose, write_png, write_transforms

from dano.cli.tracking.filming import named_frame
from dano.vision import background_mask, Capture, load_camera, load_capture, View, with_masks


@pytest.fixture(scope="module")
def photos() -> Capture:
    return capture(n_train=3, n_test=1, pixels=16)


def edit(folder: Path, change) -> None:
    content = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


def check(read: Capture, photos: Capture, *, lit: bool = True) -> None:
    assert [view.split for view in read.views] == [view.split for view in photos.views]
    for a, b in zip(read.views, photos.views, strict=True):
        assert a.mask is not None and b.mask is not None
        np.testing.assert_allclose(a.camera.rays(), b.camera.rays(), atol=1e-9)
        np.testing.assert_allclose(a.camera.position, b.camera.position, atol=1e-12)
        np.testing.assert_allclose(a.mask, b.mask, atol=0.003)
        np.testing.assert_allclose(a.image, b.image, atol=0.01)
        if lit:
            assert a.light is not None and b.light is not None
            np.testing.assert_allclose(a.light, b.light, atol=1e-12)


def test_transforms_of_nerfstudio(photos: Capture, tmp_path: Path):
    write_transforms(tmp_path, photos)
    read = load_capture(tmp_path)
    check(read, photos)
    assert read.has_masks and read.is_lit
    assert len(load_capture(tmp_path / "transforms.json").views) == 4


def test_the_camera_of_one_of_several_pictures(photos: Capture, tmp_path: Path):
    write_transforms(tmp_path, photos)
    file = tmp_path / "transforms.json"
    names = [row["file_path"] for row in json.loads(file.read_text(encoding="utf-8"))["frames"]]
    for name, view in zip(names, photos.views, strict=True):
        for given in (name, Path(name).name):
            found = load_camera(file, 16, 16, frame=given)
            np.testing.assert_allclose(found.pose, view.camera.pose, atol=1e-12)
        assert named_frame(Path(f"{file}:{name}")) == (file, name)
    assert named_frame(file) == (file, None) and named_frame(Path("a:b.png")) == (Path("a:b.png"), None)
    with pytest.raises(ValueError, match="frame must be one of .*, got 'film.png', which 0 are called"):
        load_camera(file, 16, 16, frame="film.png")
    with pytest.raises(ValueError, match="or a single frame that has it, got 4 frames"):
        load_camera(file, 16, 16)
    edit(tmp_path, lambda content: [row.pop("w", None) for row in (content, *content["frames"])])
    with pytest.raises(ValueError, match="camera must state w and h, or width and height"):
        load_camera(file, height=16, frame=names[0])


def test_blender_scenes(photos: Capture, tmp_path: Path):
    for split in ("train", "test"):
        (tmp_path / split).mkdir()
        frames = []
        for view in photos.split(split):
            assert view.mask is not None
            write_png(tmp_path / split / f"{view.name}.png", view.image, view.mask)
            matrix = np.vstack([view.camera.pose, [0, 0, 0, 1]]).tolist()
            frames.append({"file_path": f"./{split}/{view.name}", "transform_matrix": matrix})
        angle = 2 * np.arctan(0.5 * 16 / photos.views[0].camera.focal[0])
        text = json.dumps({"camera_angle_x": angle, "frames": frames})
        (tmp_path / f"transforms_{split}.json").write_text(text, encoding="utf-8")
    read = load_capture(tmp_path)
    check(read, photos, lit=False)
    assert not read.is_lit


def test_annotations_of_scattering_functions(photos: Capture, tmp_path: Path):
    (tmp_path / "rgba").mkdir()
    for split in ("train", "test"):
        records = []
        for view in photos.split(split):
            assert view.mask is not None and view.light is not None
            write_png(tmp_path / "rgba" / f"{view.name}.png", view.image, view.mask)
            rotation = view.camera.axes * np.array([1.0, -1.0, 1.0])[:, None]  # right, down, forward
            translation = -rotation @ view.camera.position
            f = float(view.camera.focal[0])
            records.append(
                {
                    "filename": f"{view.name}.png",
                    "RT": np.column_stack([rotation, translation]).tolist(),
                    "K": [[f, 0, 8], [0, f, 8], [0, 0, 1]],
                    "light_pos": (5 * view.light).tolist(),
                }
            )
        (tmp_path / f"anno_{split}.json").write_text(json.dumps(records), encoding="utf-8")
    check(load_capture(tmp_path), photos)


def test_mask_files_smaller_copies_and_held_out_views(tmp_path: Path):
    frames = []
    for i, away in enumerate(directions(16)):
        view = capture(1, 0, 16).views[0]
        write_png(tmp_path / f"{i}.png", view.image)
        assert view.mask is not None
        write_png(tmp_path / f"{i}_mask.png", np.repeat(view.mask[..., None], 3, axis=2))
        frames.append(
            {"file_path": f"{i}.png", "mask_path": f"{i}_mask.png", "transform_matrix": pose(away).tolist()}
        )
    # Intrinsics of an original of twice the size.
    content = {"fl_x": 70.0, "cx": 15.0, "cy": 17.0, "w": 32, "h": 32, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    read = load_capture(tmp_path)
    assert len(read.split("test")) == 2 and len(read.split("train")) == 14
    np.testing.assert_allclose(read.views[0].camera.focal, [35, 35])
    np.testing.assert_allclose(read.views[0].camera.centre, [7.5, 8.5])
    assert load_capture(tmp_path, hold_out=0).split("test") == ()
    small = load_capture(tmp_path, downscale=2).views[0]
    assert small.image.shape == (8, 8, 3)
    np.testing.assert_allclose(small.camera.rays()[0, 0], read.views[0].camera.directions(np.ones((1, 2)))[0])
    assert len(read.thinned(5).split("train")) == 5 and len(read.thinned(5).split("test")) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["frames"][1].update(file_path="gone.png"), "image gone.png is missing"),
        (lambda c: c["frames"][1].update(mask_path="gone.png"), "gone.png is missing"),
        (lambda c: c["frames"][1]["transform_matrix"][0].__setitem__(0, 3.0), "must hold a rotation"),
        (lambda c: c["frames"][1].update(light_direction=[0, 0, 0]), "light_direction of frame 1"),
        (lambda c: c["frames"][1].update(split="holdout"), "split of frame 1"),
        (lambda c: c["frames"][1].pop("transform_matrix"), "frame 1 must have file_path"),
        (lambda c: (c.pop("fl_x"), c.pop("fl_y")), "neither fl_x nor camera_angle_x"),
        (lambda c: c.update(camera_model="OPENCV_FISHEYE"), "undistort"),
        (lambda c: c.update(h=8), "image is 16 × 16"),
        (lambda c: c.update(frames=3), "list of frames"),
        (lambda c: [f.update(split="test") for f in c["frames"]], "views to train on"),
    ],
)
def test_bad_captures_are_refused(photos: Capture, tmp_path: Path, change, message: str):
    write_transforms(tmp_path, photos)
    edit(tmp_path, change)
    with pytest.raises(ValueError, match=message):
        load_capture(tmp_path)


def test_broken_files_are_named(photos: Capture, tmp_path: Path):
    with pytest.raises(ValueError, match="no transforms.json"):
        load_capture(tmp_path)
    write_transforms(tmp_path, photos)
    whole = (tmp_path / "train_1.png").read_bytes()
    (tmp_path / "train_1.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"train_1\.png: cannot be read as an image"):
        load_capture(tmp_path)
    (tmp_path / "transforms.json").write_text("{", encoding="utf-8")
    with pytest.raises(ValueError, match="cannot be read as JSON"):
        load_capture(tmp_path)


def without_masks(photos: Capture, background) -> Capture:
    views = []
    for view in photos.views:
        assert view.mask is not None
        image = (view.image + (1 - view.mask[..., None]) * background).astype(np.float32)
        views.append(View(name=view.name, camera=view.camera, image=image, split=view.split))
    return Capture(views)


def test_masks_come_from_a_plain_background():
    photos = capture(3, 1, 48)
    made = with_masks(without_masks(photos, np.array([0.02, 0.03, 0.02])))
    for a, b in zip(made.views, photos.views, strict=True):
        assert a.mask is not None and b.mask is not None
        assert np.mean((a.mask > 0.5) != (b.mask > 0.5)) < 0.02
    noise = np.random.default_rng(0).uniform(0, 1, (48, 48, 3))
    with pytest.raises(ValueError, match="background is not plain"):
        with_masks(without_masks(photos, noise))


def wrong_share(made: Capture, photos: Capture) -> list[float]:
    shares = []
    for a, b in zip(made.views, photos.views, strict=True):
        assert a.mask is not None and b.mask is not None
        shares.append(float(np.mean((a.mask > 0.5) != (b.mask > 0.5))))
    return shares


def test_masks_know_a_dim_cloth_from_the_object():
    photos = capture(3, 1, 48)
    cloth = np.full((48, 48, 3), 0.01)
    cloth[24:, 20:28] = 0.05
    assert max(wrong_share(with_masks(without_masks(photos, cloth)), photos)) < 0.02


def test_masks_drop_what_other_views_deny():
    photos = capture(12, 0, 48)
    views = list(without_masks(photos, 0.0).views)

    def struck(view: View) -> View:
        assert view.mask is None
        image = view.image.copy()
        image[24:, 22:26] = np.maximum(image[24:, 22:26], 0.4)
        return view.replaced(image=image)

    one = with_masks(Capture([struck(views[0]), *views[1:]]))
    assert max(wrong_share(one, photos)) < 0.03
    # If poses are wrong, what is made stays, for `survey` to find that it does not fit together.
    rng = np.random.default_rng(0)
    lost = []
    for view in views:
        place = view.camera.pose.copy()
        place[:3, 3] += rng.normal(0, 0.02, 3)
        lost.append(view.replaced(camera=view.camera.replaced(camera_to_world=place)))
    for view, made in zip(lost, with_masks(Capture(lost)).views, strict=True):
        np.testing.assert_array_equal(made.mask, background_mask(view))


def test_given_masks_are_completed_where_the_object_lies_in_shadow(tmp_path: Path):
    photos = capture(2, 0, 64)
    write_transforms(tmp_path, photos)
    for view in photos.views:
        assert view.mask is not None
        image, mask = view.image.copy(), view.mask.copy()
        # A shadow that the mask takes for a hole, and a hole that shows the background.
        image[30:34, 32:36] *= 0.5
        mask[30:34, 32:36] = 0
        image[30:34, 22:26], mask[30:34, 22:26] = 0, 0
        write_png(tmp_path / f"{view.name}.png", image)
        write_png(tmp_path / f"{view.name}_mask.png", np.repeat(mask[..., None], 3, axis=2))
    edit(tmp_path, lambda c: [f.update(mask_path=f["file_path"][:-4] + "_mask.png") for f in c["frames"]])
    with pytest.warns(RuntimeWarning, match="2 masks left out shadows on the object"):
        read = load_capture(tmp_path)
    for view in read.views:
        assert view.mask is not None
        assert view.mask[30:34, 32:36].min() == 1
        assert view.mask[31:33, 23:25].max() == 0
        assert view.image[31:33, 33:35].min() > 0.02


def test_masks_come_from_a_network(tmp_path: Path):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    photos = capture(2, 0, 32)
    # The mean of the three channels, as a mask: bright is object.
    node = onnx.helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1], keepdims=1)
    scale = onnx.helper.make_node("Add", ["mean", "half"], ["mask"])
    half = onnx.helper.make_tensor("half", onnx.TensorProto.FLOAT, [1], [0.5])
    shapes = [("image", [1, 3, 32, 32]), ("mask", [1, 1, 32, 32])]
    tensors = [onnx.helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, s) for n, s in shapes]
    graph = onnx.helper.make_graph([node, scale], "mean", tensors[:1], tensors[1:], [half])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, tmp_path / "mean.onnx")
    made = with_masks(without_masks(photos, 0.0), tmp_path / "mean.onnx")
    assert made.views[0].mask is not None
    np.testing.assert_allclose(made.views[0].mask, photos.views[0].image.mean(axis=2), atol=1e-5)
    with pytest.raises(ValueError, match="does not exist"):
        with_masks(without_masks(photos, 0.0), tmp_path / "gone.onnx")
