"""Which model is in a file."""

from pathlib import Path

from dano.archive import format_of
from dano.vision.radiance import _learned, _osf


def model_of_file(path: Path) -> _osf.OSF | _learned.LearnedField:
    """The model that a file holds, by the format that the file says it is of.

    Raises:
        ValueError: If it is none of these, or damaged.
    """
    models = {_osf.FORMAT: _osf.OSF, _learned.FORMAT: _learned.LearnedField}
    form = format_of(path)
    if form not in models:
        raise ValueError(f"{path} must be of one of the formats {list(models)}, got {form!r}")
    return models[form].load(path)
