"""Optional packages: imported where they are needed, or an error that names the extra with them."""

import importlib
import importlib.util
from typing import Any, NamedTuple


def is_installed(module: str) -> bool:
    """Whether a module can be imported; nothing is imported."""
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        # Of a module within a package, which is missing.
        return False


def optional(module: str, need: str, extra: str) -> Any:
    """Import a module of an optional package.

    Args:
        module: Its name, such as "PIL.Image".
        need: What needs which package, such as "textures need pillow".
        extra: The extra of dano that installs it.

    Raises:
        ImportError: If it is missing; says the need and how to install the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(_message(need, extra)) from error


class Package(NamedTuple):
    """An optional package that several places need."""

    module: str  # Its name
    need: str  # What needs it, in words
    extra: str  # The extra of dano that installs it

    def load(self) -> Any:
        """Import it.

        Raises:
            ImportError: As `optional`.
        """
        return optional(*self)

    def check(self) -> None:
        """Look for it before work begins, without the time that importing takes.

        Raises:
            ImportError: As `optional`.
        """
        if not is_installed(self.module):
            raise ImportError(_message(self.need, self.extra))


COLMAP = Package("pycolmap", "poses of photographs need pycolmap", "poses")
OPENCV = Package("cv2", "poses of photographs need OpenCV", "poses")
NETWORKS = Package("onnxruntime", "masks by a network need onnxruntime", "segment")
PHOTOGRAPHS = Package("PIL.Image", "reading photographs needs pillow", "train")
VIDEO_FILES = Package("av", "reading videos needs av", "view")
MESHES = Package("trimesh", "reading meshes needs trimesh", "mesh")
DISTANCES = Package("igl", "signed distances of meshes need libigl", "mesh")


def _message(need: str, extra: str) -> str:
    return f"{need}: pip install 'dano[{extra}]'"
