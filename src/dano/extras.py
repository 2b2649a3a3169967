"""Optional packages: imported where they are needed, or an error that names the extra with them."""

import importlib
import importlib.util
from typing import Any


def is_installed(module: str) -> bool:
    """Whether a module can be imported; nothing is imported."""
    return importlib.util.find_spec(module) is not None


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
        raise ImportError(f"{need}: pip install 'dano[{extra}]'") from error
