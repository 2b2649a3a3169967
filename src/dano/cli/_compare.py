"""`dano compare`."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg, Positional


def compare(
    object: Positional[Path],
    /,
    output: Annotated[Path, arg(aliases=["-o"])],
    field: Path | None = None,
    truth: Path | None = None,
    truth_scale: float = 1.0,
    levels: tuple[float, ...] = (),
    drops: int = 3,
    no_decomposition: bool = False,
    seed: int = 0,
    json: bool = False,
) -> Callable[[], None]:
    """Measure meshes of an object in MuJoCo and PyBullet against the object itself.

    Writes a page with pictures of what lies on the floor and a table of errors and times.

    Args:
        object: A neural object (.dano).
        output: The page (.html).
        field: The density that meshes are made of; default: the object's own, which has no floaters left.
        truth: The true solid (a closed mesh, or a signed distance), in the frame of the object.
        truth_scale: Length of a unit of its file [m].
        levels: Densities of the surfaces; default: five from near nothing to the density inside.
        drops: Random orientations to drop from.
        no_decomposition: Leave out convex pieces, which take many minutes for a ragged surface.
        seed: Of these.
        json: Print one JSON object instead of text.
    """
    files = {"field": field, "truth": truth, "truth_scale": truth_scale}
    options = {
        "levels": levels or None,
        "drops": drops,
        "decomposed": not no_decomposition,
        "seed": seed,
    }
    return functools.partial(_run, object, output, files, options, json)


def _run(path: Path, output: Path, files: dict[str, Any], options: dict[str, Any], as_json: bool) -> None:
    # Here, so that `dano --help` answers at once.
    from dano.cli._console import Progress, put, put_json
    from dano.cli._outputs import check_output
    from dano.comparison import compare as measure
    from dano.fields import AbstractShape, load_field
    from dano.objects import NeuralObject
    from dano.report import verdict, write_comparison_report

    inputs = [file for file in (path, files["field"], files["truth"]) if file is not None]
    check_output(output, *inputs, suffix=".html")
    truth = None
    if files["truth"] is not None:
        truth = load_field(files["truth"], scale=files["truth_scale"])
        if not isinstance(truth, AbstractShape):
            raise ValueError(
                f"truth must be a closed mesh or a signed distance, got a {type(truth).__name__} in"
                f" {files['truth']}"
            )
    field = None if files["field"] is None else load_field(files["field"])
    made = NeuralObject.load(path)
    progress = Progress()
    found = measure(made, field=field, truth=truth, progress=progress, **options)
    progress.close()
    write_comparison_report(output, found, title=f"{path.stem}: meshes and the neural object")
    if as_json:
        rows = [row._asdict() for row in found.rows]
        put_json({**found._asdict(), "rows": rows, "scenery": len(found.scenery), "page": str(output)})
        return
    for row in found.rows:
        level = "" if row.level != row.level else f" at {row.level:.3g}"
        put(f"{row.route + level:<44} {row.engine:<9} {verdict(row)}")
    for text in found.missing:
        put(text)
    put(f"wrote {output}")
