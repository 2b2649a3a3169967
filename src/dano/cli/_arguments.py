"""The commands' arguments, one class a command, and nothing that is slow to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg, Positional

from dano.building import BuildOptions, Units, Up
from dano.exchange import ExportOptions

UNNAMED = Path("<named after the input>")
"""Stands for an output that nobody named, see `dano.cli._outputs.named`; help shows it as the default."""
Output = Annotated[Path, arg(aliases=["-o"])]


@dataclass(frozen=True)
class Train:
    """Learn a solid neural object from photographs with known poses.

    Writes the object, and beside it the learned field (.field.npz), its density grid (.grid.npz) and a report
    (.html).
    """

    images: Positional[Path]  # Folder with transforms.json or anno_train.json, or one of these files
    output: Output = UNNAMED  # Where to write the object, *.dano
    resolution: int = 96  # Nodes along the longest side of the object
    iterations: int = 800  # Largest number of training steps
    batch: int = 4096  # Rays per step
    seconds: float | None = None  # Stop training after this time [s]
    views: int | None = None  # Number of views to train on; default: all
    downscale: int = 1  # Average so many pixels a side into one
    # Segmentation network (.onnx) for photographs without masks; default: what differs from the background.
    network: Path | None = None
    mass: float | None = None  # Mass of the object [kg]
    mass_density: float = 1000.0  # Mass per volume [kg/m³], used if no mass is given
    # Height z of a level table that the object stands on in the photographs [m]: nothing of it is below, and
    # photographs without masks get those of what stands there.
    table: float | None = None
    resume: bool = False  # Continue a training that was interrupted
    no_report: bool = False  # Write no report
    seed: int = 0  # Seed of all random numbers
    json: Path | None = None  # Write figures of merit and mass properties to this file
    # Folder for pictures of the training: held-out photographs beside what is learned so far.
    previews: Path | None = None


@dataclass(frozen=True)
class FindPoses:
    """Find where photographs were taken from: structure from motion. For `dano data` and `dano train`.

    Lengths are metres only if a printed marker or a measured length says so. Without either the result says
    that the scale is not known.
    """

    # Folder of photographs (or one with `images` in it), or a video, whose frames are written beside the
    # output.
    images: Positional[Path]
    further: Positional[tuple[Path, ...]] = ()  # More of them, of the same object in the same place
    output: Output = UNNAMED  # Where to write the cameras, such as transforms.json
    # Folder with a mask for each photograph, bright where the object is; default: `masks` in or beside the
    # folder of photographs, or their alpha channel.
    masks: Path | None = None
    # Where points are looked for, if there are masks: object for turntables, surroundings for walks around an
    # object; auto: the object if what is around it is plain or stands still, the surroundings otherwise.
    features_on: Literal["auto", "everything", "object", "surroundings"] = "auto"
    marker_size: float | None = None  # Side of the black square of printed markers [m]
    # Their dictionary, by OpenCV's name, such as DICT_APRILTAG_36h11 or DICT_4X4_50.
    marker_family: str = "DICT_APRILTAG_36h11"
    length: float | None = None  # A measured length [m], between --ends
    ends: tuple[str, ...] = ()  # Where its ends are in some photographs, as NAME:X,Y:X,Y [pixels]
    # What shows where up is: a marker that lies flat, the plane of the table, cameras held level; auto: the
    # first of these that can be had.
    up: Literal["auto", "marker", "plane", "cameras", "none"] = "auto"
    # Known focal length, or two, across and down [pixels of the upright photograph]; default: estimated.
    focal: tuple[float, ...] = ()
    centre: tuple[float, float] | None = None  # Known principal point [pixels]; default: the middle
    distortion: tuple[float, float, float, float] | None = None  # Known k1 k2 p1 p2 of OpenCV's model
    # What is estimated of the lens: radial (focal length and k1), pinhole (focal length), full (two focal
    # lengths, k1, k2, p1, p2).
    lens: Literal["radial", "pinhole", "full"] = "radial"
    frames: int = 80  # Most frames of a video, or of several together
    since: Annotated[float | None, arg(name="from")] = None  # Take frames of videos from this time on [s]
    until: Annotated[float | None, arg(name="to")] = None  # Take frames of videos up to this time [s]
    features: int = 3000  # Most points of a photograph
    model: int = 1  # Which model to write if photographs fall into several, from 1, the largest
    seed: int = 0  # Seed of all random numbers
    json: bool = False  # Print one JSON object instead of text


@dataclass(frozen=True)
class CheckPhotographs:
    """Check photographs before training: poses, masks, coverage. Draw the cameras."""

    images: Positional[Path]  # Folder with transforms.json or anno_train.json, or one of these files
    png: Path | None = None  # Where to draw; default: the folder's name in the current folder
    no_png: bool = False  # Draw nothing
    downscale: int = 1  # Average so many pixels a side into one
    network: Path | None = None  # Segmentation network (.onnx) for photographs without masks
    # Height z of a level table [m]: without a network, masks are those of what stands on it.
    table: float | None = None
    json: bool = False  # Print one JSON object instead of text


@dataclass(frozen=True)
class BuildObject:
    """Make a neural object of a density field: mass, centre of mass, inertia, contact samples."""

    # Density grid (.npz with values, origin, spacing), voxels (.npy), mesh (.obj, .stl, …), object (.dano), a
    # shipped one (bunny, soap, …), or what `dano import` reads. Or a part of one object: a mesh with its
    # density [kg/m³] or mass, as blade.ply:7850 or grip.ply:0.3kg.
    field: Positional[Path]
    further: Positional[tuple[Path, ...]] = ()  # Its other parts, in the same frame and units
    output: Output = UNNAMED  # Where to write the object, usually *.dano
    options: Annotated[BuildOptions, arg(name="")] = BuildOptions()  # How to make it
    json: bool = False  # Print one JSON object instead of text


@dataclass(frozen=True)
class Import:
    """Read a field of another program and write it as a grid that dano reads.

    With `--to`, Gaussian splats become an object in a folder that MuJoCo or Newton loads, splats included.
    """

    # nerfstudio checkpoint (.ckpt), instant-ngp snapshot (.ingp, .msgpack), Gaussian splats (.ply), OpenVDB
    # or NanoVDB grid (.vdb, .nvdb), PyTorch module (.pt2, .pt, .pth), voxels (.npy, .npz), model of dano
    # (.npz), mesh (.obj, .stl, .ply, .off, .glb, .gltf, .3mf, .dae, .step), a shipped one (bunny, soap,
    # trained_bunny, trained_soap), or a function as package.module:name.
    file: Positional[str]
    output: Output = UNNAMED  # Where to write the grid (.npz), or with --to the folder
    # Box to keep: lowest x y z, highest x y z, in the file's frame and units.
    crop: tuple[float, float, float, float, float, float] | None = None
    # Length of a unit of the file [m]; default: as meshes say or their size tells, else 1.
    scale: float | None = None
    units: Units | None = None  # The same by name
    # Meshes: which axis of the file points up; it is turned so that z does. Default: y in glTF, else z.
    up: Up | None = None
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Moves the scaled field [m]
    # Turns the scaled field before it is moved; quaternion w x y z.
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    # Nodes along the longest axis, for files that hold no grid; default 128, for meshes as many as their
    # walls need.
    resolution: int | None = None
    # How the grid is interpolated between its nodes; default: as the format has it.
    interpolation: Literal["linear", "quadratic", "cubic"] | None = None
    # Gaussian splats: leave out those with numbers that are not finite; how many is said.
    skip_nan: bool = False
    # Gaussian splats: take one object out of a scene, the Gaussians whose centre lies in this box: lowest x y
    # z, highest x y z, in the file's frame and units.
    box: tuple[float, float, float, float, float, float] | None = None
    sphere: tuple[float, float, float, float] | None = None  # The same for a sphere: centre x y z, radius
    # Gaussian splats: write a folder as `dano export` does, with the Gaussians for cameras: mjcf, usd.
    to: tuple[Literal["mjcf", "urdf", "usd", "obj"], ...] = ()
    mass: float | None = None  # With --to: mass of the object [kg]; default: as dense as water
    # Gaussian splats: do not fill the inside. Splats lie on surfaces, so their inside is empty.
    hollow: bool = False
    # Voxels (.npy): distance between voxels in the file's units; default: longest side 1.
    spacing: float | None = None
    origin: tuple[float, float, float] | None = None  # Voxels (.npy): centre of the first voxel
    signed_distance: bool = False  # Voxels (.npy) are signed distances, negative inside
    grid: str | None = None  # OpenVDB, NanoVDB: name of the grid
    cascade: int | None = None  # instant-ngp: which cascade of the density grid; 0 is the finest
    # Weights (.pt, .pth): package.module:name of the class or function that makes their torch.nn.Module. Its
    # code runs.
    module: str | None = None
    keep_transform: bool = False  # nerfstudio: keep the frame of training; default: the frame of the data set
    json: bool = False  # Print one JSON object instead of text


@dataclass(frozen=True)
class Inspect:
    """Print an object's mass properties and samples, and draw it; or a robot's tree and what is odd."""

    # A neural object (.dano), a shipped one (bunny, soap, trained_bunny, trained_soap), a mesh or field,
    # which is built with defaults, or a robot (.urdf, or a .xml of MuJoCo).
    object: Positional[Path]
    png: Path | None = None  # Where to draw it; default: beside the object
    no_png: bool = False  # Draw nothing
    json: bool = False  # Print one JSON object instead of text


@dataclass(frozen=True)
class Simulate:
    """Simulate a scene, or drop an object onto a floor. Of two scenes: both, to compare them."""

    # A scene file (.toml); or what is dropped onto a floor: a neural object (.dano), a shipped one (bunny,
    # soap, trained_bunny, trained_soap), or a mesh or field, which is built with defaults.
    scene: Positional[Path]
    beside: Positional[Path | None] = None  # Another one, to compare with
    # Where to write the trajectory, usually *.npz; of two scenes the folder for both.
    output: Output = UNNAMED
    video: Path | None = None  # Where to write a video (.mp4); two scenes are side by side in it
    # Where to write a picture of several moments side by side (.png); two scenes have a row each.
    strip: Path | None = None
    steps: int | None = None  # Number of steps; default: the scene's
    timestep: float | None = None  # Timestep [s]; default: the scene's
    # fixed: sees all bodies all the time; follow: shifts with those that move; auto: follows if bodies would
    # otherwise fill less than a third of the height; scene: the scene file's, in its size.
    camera: Literal["auto", "fixed", "follow", "scene"] = "auto"
    size: tuple[int, int] = (640, 400)  # Width and height of pictures [pixels], even numbers
    draft: bool = False  # Draw quickly: half the size, at most 15 frames per second, no shadows, rough edges
    slow_motion: float = 1.0  # Video seconds per simulated second
    # Go on with a run that was interrupted or killed; the result is the same to the last bit.
    resume: bool = False
    json: bool = False  # Print one JSON object instead of text


@dataclass(frozen=True)
class PlanTask:
    """Find forces that do a task: bring bodies to goals, through contact."""

    scene: Positional[Path]  # Scene file (.toml)
    # Task file (.toml): actuators, goals, limits. The guide "Planning" lists its keys.
    task: Positional[Path]
    output: Output = UNNAMED  # Where to write the plan (.npz)
    video: Path | None = None  # Where to write a video with ghosts at the goals (.mp4)
    strip: Path | None = None  # Where to write a picture of several moments side by side (.png)
    controls: Path | None = None  # Where to write a picture of the controls over time (.png)
    method: Literal["ilqr", "cem", "mppi"] | None = None  # How to search; default: the task's, or ilqr
    slow_motion: float = 1.0  # Video seconds per simulated second
    json: bool = False  # Print one JSON object instead of text


@dataclass(frozen=True)
class View:
    """Look at a run, a scene, an object, a field or photographs with poses in the browser."""

    # A run of `dano simulate` (.npz); a scene file (.toml) or a neural object (.dano), which is simulated,
    # and again when a slider of the page moves; a field that `dano build` reads, with a slider for the
    # density of its surface; Gaussian splats (.ply), out of which a click chooses an object for `dano
    # import`; transforms.json or a folder that holds it, whose cameras are drawn.
    source: Positional[Path]
    beside: Path | None = None  # Another run of the same bodies, drawn translucent over the first
    # Where to write the page as one file that can be sent to others (.html), instead of serving it.
    page: Path | None = None
    port: int = 8080  # Port of the page on this computer


@dataclass(frozen=True)
class Export:
    """Write an object as a folder that other simulators load.

    Mass, centre of mass and inertia are the object's; what is seen has the learned colours; what touches are
    convex pieces. README.md in the folder says what the format cannot hold.
    """

    object: Positional[Path]  # A neural object (.dano), a shipped one (bunny, …), or a mesh or field
    output: Output = UNNAMED  # The folder; new, empty, or of an earlier export, which is replaced
    # Formats: mjcf (MuJoCo), urdf (PyBullet, ROS), usd (Isaac, Newton), obj (meshes only).
    to: tuple[Literal["mjcf", "urdf", "usd", "obj"], ...] = ("mjcf",)
    name: str | None = None  # Of the body and the files; default: the object's file's
    friction: float = 0.2  # Sliding friction
    restitution: float | None = None  # Coefficient of restitution, where the format has one
    options: Annotated[ExportOptions, arg(name="")] = ExportOptions()  # How
    json: bool = False  # Print one JSON object instead of text


@dataclass(frozen=True)
class Compare:
    """Measure meshes of an object in MuJoCo and PyBullet against the object itself.

    Writes a page with pictures of the objects at rest on the floor and a table of errors and times.
    """

    object: Positional[Path]  # A neural object (.dano)
    output: Output = UNNAMED  # The page (.html)
    # The density that meshes are made of; default: the object's own, which has no floaters left.
    field: Path | None = None
    # The true solid (a closed mesh, or a signed distance), in the frame of the object.
    truth: Path | None = None
    # Length of a unit of its file [m]; default: as meshes say or their size tells, else 1.
    truth_scale: float | None = None
    # Densities of the surfaces; default: five from near nothing to the density inside.
    levels: tuple[float, ...] = ()
    drops: int = 3  # Random orientations to drop from
    no_decomposition: bool = False  # Leave out convex pieces, which take many minutes for a ragged surface
    seed: int = 0  # Of these orientations
    json: bool = False  # Print one JSON object instead of text


@dataclass(frozen=True)
class Cache:
    """Show what is kept between commands, clear it, or limit it.

    Objects built of meshes and fields, shapes of robots' meshes, kernels and compiled programs: how many, how
    large, when used last. What is removed is made again when it is needed.
    """

    # Only these; default: all.
    kinds: Positional[tuple[Literal["objects", "meshes", "kernels", "compiled"], ...]] = ()
    clear: bool = False  # Remove them
    # Remove what was not used for longest until no more than this is left, such as 500MB.
    limit: str | None = None
    json: bool = False  # Print one JSON object instead of text


@dataclass(frozen=True)
class Demo:
    """Build the shipped objects, simulate a scene of them, and draw everything."""

    # drop: a bunny, a bar of soap and a ball fall. collision: a ball hits two bunnies. all: both. soap: from
    # photographs and a film of a bar of soap to its friction, in some minutes.
    name: Positional[Literal["all", "drop", "collision", "soap"]] = "drop"
    output: Output = Path("dano-demo")  # Folder for everything that is written
    draft: bool = False  # As of `dano simulate`
    json: bool = False  # Print one JSON object instead of text
