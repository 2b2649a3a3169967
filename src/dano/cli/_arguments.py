"""The commands' arguments, one class a command, and nothing that is slow to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg, Positional

from dano.building import BuildOptions, Units, Up

UNNAMED = Path("<named after the input>")
"""Stands for an output that nobody named, see `dano.cli._outputs.named`; help shows it as the default."""
Output = Annotated[Path, arg(aliases=["-o"])]


@dataclass(frozen=True)
class Train:
    """Learn a solid neural object from photographs with known poses.

    Writes the object, and beside it the learned field (.field.npz), its density grid (.grid.npz) and a report
    (.html).

    Attributes:
        images: Folder with transforms.json or anno_train.json, or one of these files.
        output: Where to write the object, *.dano.
        resolution: Nodes along the longest side of the object.
        iterations: Largest number of training steps.
        batch: Rays per step.
        seconds: Stop training after this time [s].
        views: Number of views to train on; default: all.
        downscale: Average so many pixels a side into one.
        network: Segmentation network (.onnx) for photographs without masks; default: what differs from the
            background.
        mass: Mass of the object [kg].
        mass_density: Mass per volume [kg/m³], used if no mass is given.
        table: Height z of a level table that the object stands on in the photographs [m]: nothing of it is
            below, and photographs without masks get those of what stands there.
        resume: Continue a training that was interrupted.
        no_report: Write no report.
        seed: Seed of all random numbers.
        json: Write figures of merit and mass properties to this file.
        previews: Folder for pictures of the training: held-out photographs beside what is learned so far.
    """

    images: Positional[Path]
    output: Output = UNNAMED
    resolution: int = 96
    iterations: int = 800
    batch: int = 4096
    seconds: float | None = None
    views: int | None = None
    downscale: int = 1
    network: Path | None = None
    mass: float | None = None
    mass_density: float = 1000.0
    table: float | None = None
    resume: bool = False
    no_report: bool = False
    seed: int = 0
    json: Path | None = None
    previews: Path | None = None


@dataclass(frozen=True)
class Poses:
    """Find where photographs were taken from: structure from motion. For `dano data` and `dano train`.

    Lengths are metres only if a printed marker or a measured length says so. Without either the result says
    that the scale is not known.

    Attributes:
        images: Folder of photographs (or one with `images` in it), or a video, whose frames are written
            beside the output.
        further: More of them, of the same object in the same place.
        output: Where to write the cameras, such as transforms.json.
        masks: Folder with a mask for each photograph, bright where the object is; default: `masks` in or
            beside the folder of photographs, or their alpha channel.
        features_on: Where points are looked for, if there are masks: object for turntables, surroundings for
            walks around an object; auto: the object if what is around it is plain or stands still, the
            surroundings otherwise.
        marker_size: Side of the black square of printed markers [m].
        marker_family: Their dictionary, by OpenCV's name, such as DICT_APRILTAG_36h11 or DICT_4X4_50.
        length: A measured length [m], between --ends.
        ends: Where its ends are in some photographs, as NAME:X,Y:X,Y [pixels].
        up: What shows where up is: a marker that lies flat, the plane of the table, cameras held level; auto:
            the first of these that can be had.
        focal: Known focal length, or two, across and down [pixels of the upright photograph]; default:
            estimated.
        centre: Known principal point [pixels]; default: the middle.
        distortion: Known k1 k2 p1 p2 of OpenCV's model.
        lens: What is estimated of the lens: radial (focal length and k1), pinhole (focal length), full (two
            focal lengths, k1, k2, p1, p2).
        frames: Most frames of a video, or of several together.
        since: Take frames of videos from this time on [s].
        until: Take frames of videos up to this time [s].
        features: Most points of a photograph.
        model: Which model to write if photographs fall into several, from 1, the largest.
        seed: Seed of all random numbers.
        json: Print one JSON object instead of text.
    """

    images: Positional[Path]
    further: Positional[tuple[Path, ...]] = ()
    output: Output = UNNAMED
    masks: Path | None = None
    features_on: Literal["auto", "everything", "object", "surroundings"] = "auto"
    marker_size: float | None = None
    marker_family: str = "DICT_APRILTAG_36h11"
    length: float | None = None
    ends: tuple[str, ...] = ()
    up: Literal["auto", "marker", "plane", "cameras", "none"] = "auto"
    focal: tuple[float, ...] = ()
    centre: tuple[float, float] | None = None
    distortion: tuple[float, float, float, float] | None = None
    lens: Literal["radial", "pinhole", "full"] = "radial"
    frames: int = 80
    since: Annotated[float | None, arg(name="from")] = None
    until: Annotated[float | None, arg(name="to")] = None
    features: int = 3000
    model: int = 1
    seed: int = 0
    json: bool = False


@dataclass(frozen=True)
class Data:
    """Check photographs before training: poses, masks, coverage. Draw the cameras.

    Attributes:
        images: Folder with transforms.json or anno_train.json, or one of these files.
        png: Where to draw; default: the folder's name in the current folder.
        no_png: Draw nothing.
        downscale: Average so many pixels a side into one.
        network: Segmentation network (.onnx) for photographs without masks.
        table: Height z of a level table [m]: without a network, masks are those of what stands on it.
        json: Print one JSON object instead of text.
    """

    images: Positional[Path]
    png: Path | None = None
    no_png: bool = False
    downscale: int = 1
    network: Path | None = None
    table: float | None = None
    json: bool = False


@dataclass(frozen=True)
class Build:
    """Make a neural object of a density field: mass, centre of mass, inertia, contact samples.

    Attributes:
        field: Density grid (.npz with values, origin, spacing), voxels (.npy), mesh (.obj, .stl, …), object
            (.dano), a shipped one (bunny, soap, …), or what `dano import` reads. Or a part of one object: a
            mesh with its density [kg/m³] or mass, as blade.ply:7850 or grip.ply:0.3kg.
        further: Its other parts, in the same frame and units.
        output: Where to write the object, usually *.dano.
        options: How to make it.
        json: Print one JSON object instead of text.
    """

    field: Positional[Path]
    further: Positional[tuple[Path, ...]] = ()
    output: Output = UNNAMED
    options: Annotated[BuildOptions, arg(name="")] = BuildOptions()
    json: bool = False


@dataclass(frozen=True)
class Import:
    """Read a field of another program and write it as a grid that dano reads.

    With `--to`, Gaussian splats become an object in a folder that MuJoCo or Newton loads, splats included.

    Attributes:
        file: nerfstudio checkpoint (.ckpt), instant-ngp snapshot (.ingp, .msgpack), Gaussian splats (.ply),
            OpenVDB or NanoVDB grid (.vdb, .nvdb), PyTorch module (.pt2, .pt, .pth), voxels (.npy, .npz),
            model of dano (.npz), mesh (.obj, .stl, .ply, .off, .glb, .gltf, .3mf, .dae, .step), a shipped one
            (bunny, soap, trained_bunny, trained_soap), or a function as package.module:name.
        output: Where to write the grid (.npz), or with --to the folder.
        crop: Box to keep: lowest x y z, highest x y z, in the file's frame and units.
        scale: Length of a unit of the file [m]; default: as meshes say or their size tells, else 1.
        units: The same by name.
        up: Meshes: which axis of the file points up; it is turned so that z does. Default: y in glTF, else z.
        position: Moves the scaled field [m].
        orientation: Turns the scaled field before it is moved; quaternion w x y z.
        resolution: Nodes along the longest axis, for files that hold no grid; default 128, for meshes as many
            as their walls need.
        interpolation: How the grid is interpolated between its nodes; default: as the format has it.
        skip_nan: Gaussian splats: leave out those with numbers that are not finite; how many is said.
        box: Gaussian splats: take one object out of a scene, the Gaussians whose centre lies in this box:
            lowest x y z, highest x y z, in the file's frame and units.
        sphere: The same for a sphere: centre x y z, radius.
        to: Gaussian splats: write a folder as `dano export` does, with the Gaussians for cameras: mjcf, usd.
        mass: With --to: mass of the object [kg]; default: as dense as water.
        hollow: Gaussian splats: do not fill the inside. Splats lie on surfaces, so their inside is empty.
        spacing: Voxels (.npy): distance between voxels in the file's units; default: longest side 1.
        origin: Voxels (.npy): centre of the first voxel.
        signed_distance: Voxels (.npy) are signed distances, negative inside.
        grid: OpenVDB, NanoVDB: name of the grid.
        cascade: instant-ngp: which cascade of the density grid; 0 is the finest.
        module: Weights (.pt, .pth): package.module:name of the class or function that makes their
            torch.nn.Module. Its code runs.
        keep_transform: nerfstudio: keep the frame of training; default: the frame of the data set.
        json: Print one JSON object instead of text.
    """

    file: Positional[str]
    output: Output = UNNAMED
    crop: tuple[float, float, float, float, float, float] | None = None
    scale: float | None = None
    units: Units | None = None
    up: Up | None = None
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    resolution: int | None = None
    interpolation: Literal["linear", "quadratic", "cubic"] | None = None
    skip_nan: bool = False
    box: tuple[float, float, float, float, float, float] | None = None
    sphere: tuple[float, float, float, float] | None = None
    to: tuple[Literal["mjcf", "urdf", "usd", "obj"], ...] = ()
    mass: float | None = None
    hollow: bool = False
    spacing: float | None = None
    origin: tuple[float, float, float] | None = None
    signed_distance: bool = False
    grid: str | None = None
    cascade: int | None = None
    module: str | None = None
    keep_transform: bool = False
    json: bool = False


@dataclass(frozen=True)
class Inspect:
    """Print an object's mass properties and samples, and draw it; or a robot's tree and what is odd.

    Attributes:
        object: A neural object (.dano), a shipped one (bunny, soap, trained_bunny, trained_soap), a mesh or
            field, which is built with defaults, or a robot (.urdf, or a .xml of MuJoCo).
        png: Where to draw it; default: beside the object.
        no_png: Draw nothing.
        json: Print one JSON object instead of text.
    """

    object: Positional[Path]
    png: Path | None = None
    no_png: bool = False
    json: bool = False


@dataclass(frozen=True)
class Simulate:
    """Simulate a scene, or drop an object onto a floor. Of two scenes: both, to compare them.

    Attributes:
        scene: A scene file (.toml); or what is dropped onto a floor: a neural object (.dano), a shipped one
            (bunny, soap, trained_bunny, trained_soap), or a mesh or field, which is built with defaults.
        beside: Another one, to compare with.
        output: Where to write the trajectory, usually *.npz; of two scenes the folder for both.
        video: Where to write a video (.mp4); two scenes are side by side in it.
        strip: Where to write a picture of several moments side by side (.png); two scenes have a row each.
        steps: Number of steps; default: the scene's.
        timestep: Timestep [s]; default: the scene's.
        camera: fixed: sees all bodies all the time; follow: shifts with those that move; auto: follows if
            bodies would otherwise fill less than a third of the height; scene: the scene file's, in its size.
        size: Width and height of pictures [pixels], even numbers.
        draft: Draw quickly: half the size, at most 15 frames per second, no shadows, rough edges.
        slow_motion: Video seconds per simulated second.
        resume: Go on with a run that was interrupted or killed; the result is the same to the last bit.
        json: Print one JSON object instead of text.
    """

    scene: Positional[Path]
    beside: Positional[Path | None] = None
    output: Output = UNNAMED
    video: Path | None = None
    strip: Path | None = None
    steps: int | None = None
    timestep: float | None = None
    camera: Literal["auto", "fixed", "follow", "scene"] = "auto"
    size: tuple[int, int] = (640, 400)
    draft: bool = False
    slow_motion: float = 1.0
    resume: bool = False
    json: bool = False


@dataclass(frozen=True)
class Plan:
    """Find forces that do a task: bring bodies to goals, through contact.

    Attributes:
        scene: Scene file (.toml).
        task: Task file (.toml): actuators, goals, limits. The guide "Planning" lists its keys.
        output: Where to write the plan (.npz).
        video: Where to write a video with ghosts at the goals (.mp4).
        strip: Where to write a picture of several moments side by side (.png).
        controls: Where to write a picture of the controls over time (.png).
        method: How to search; default: the task's, or ilqr.
        slow_motion: Video seconds per simulated second.
        json: Print one JSON object instead of text.
    """

    scene: Positional[Path]
    task: Positional[Path]
    output: Output = UNNAMED
    video: Path | None = None
    strip: Path | None = None
    controls: Path | None = None
    method: Literal["ilqr", "cem", "mppi"] | None = None
    slow_motion: float = 1.0
    json: bool = False


@dataclass(frozen=True)
class View:
    """Look at a run, a scene, an object, a field or photographs with poses in the browser.

    Attributes:
        source: A run of `dano simulate` (.npz); a scene file (.toml) or a neural object (.dano), which is
            simulated, and again when a slider of the page moves; a field that `dano build` reads, with a
            slider for the density of its surface; Gaussian splats (.ply), out of which a click chooses an
            object for `dano import`; transforms.json or a folder that holds it, whose cameras are drawn.
        beside: Another run of the same bodies, drawn translucent over the first.
        page: Where to write the page as one file that can be sent to others (.html), instead of serving it.
        port: Port of the page on this computer.
    """

    source: Positional[Path]
    beside: Path | None = None
    page: Path | None = None
    port: int = 8080


@dataclass(frozen=True)
class Export:
    """Write an object as a folder that other simulators load.

    Mass, centre of mass and inertia are the object's; what is seen has the learned colours; what touches are
    convex pieces. README.md in the folder says what the format cannot hold.

    Attributes:
        object: A neural object (.dano), a shipped one (bunny, …), or a mesh or field.
        output: The folder; new, empty, or of an earlier export, which is replaced.
        to: Formats: mjcf (MuJoCo), urdf (PyBullet, ROS), usd (Isaac, Newton), obj (meshes only).
        name: Of the body and the files; default: the object's file's.
        collision: coacd: convex decomposition; hull: convex hull; auto: the first if coacd is installed.
        concavity: How deep a convex piece may cut across, as a share of the size.
        max_pieces: Most convex pieces; default: as many as it takes.
        friction: Sliding friction.
        restitution: Coefficient of restitution, where the format has one.
        resolution: Nodes along the longest axis for the visible surface.
        texture_size: Texels along the picture with the colours.
        json: Print one JSON object instead of text.
    """

    object: Positional[Path]
    output: Output = UNNAMED
    to: tuple[Literal["mjcf", "urdf", "usd", "obj"], ...] = ("mjcf",)
    name: str | None = None
    collision: Literal["auto", "coacd", "hull"] = "auto"
    concavity: float = 0.05
    max_pieces: int | None = None
    friction: float = 0.2
    restitution: float | None = None
    resolution: int = 64
    texture_size: int = 1024
    json: bool = False


@dataclass(frozen=True)
class Compare:
    """Measure meshes of an object in MuJoCo and PyBullet against the object itself.

    Writes a page with pictures of the objects at rest on the floor and a table of errors and times.

    Attributes:
        object: A neural object (.dano).
        output: The page (.html).
        field: The density that meshes are made of; default: the object's own, which has no floaters left.
        truth: The true solid (a closed mesh, or a signed distance), in the frame of the object.
        truth_scale: Length of a unit of its file [m]; default: as meshes say or their size tells, else 1.
        levels: Densities of the surfaces; default: five from near nothing to the density inside.
        drops: Random orientations to drop from.
        no_decomposition: Leave out convex pieces, which take many minutes for a ragged surface.
        seed: Of these orientations.
        json: Print one JSON object instead of text.
    """

    object: Positional[Path]
    output: Output = UNNAMED
    field: Path | None = None
    truth: Path | None = None
    truth_scale: float | None = None
    levels: tuple[float, ...] = ()
    drops: int = 3
    no_decomposition: bool = False
    seed: int = 0
    json: bool = False


@dataclass(frozen=True)
class Cache:
    """Show what is kept between commands, clear it, or limit it.

    Objects built of meshes and fields, shapes of robots' meshes, kernels and compiled programs: how many, how
    large, when used last. What is removed is made again when it is needed.

    Attributes:
        kinds: Only these; default: all.
        clear: Remove them.
        limit: Remove what was not used for longest until no more than this is left, such as 500MB.
        json: Print one JSON object instead of text.
    """

    kinds: Positional[tuple[Literal["objects", "meshes", "kernels", "compiled"], ...]] = ()
    clear: bool = False
    limit: str | None = None
    json: bool = False


@dataclass(frozen=True)
class Demo:
    """Build the shipped objects, simulate a scene of them, and draw everything.

    Attributes:
        name: drop: a bunny, a bar of soap and a ball fall. collision: a ball hits two bunnies. all: both.
            soap: from photographs and a film of a bar of soap to its friction, in some minutes.
        output: Folder for everything that is written.
        draft: As of `dano simulate`.
        json: Print one JSON object instead of text.
    """

    name: Positional[Literal["all", "drop", "collision", "soap"]] = "drop"
    output: Output = Path("dano-demo")
    draft: bool = False
    json: bool = False
