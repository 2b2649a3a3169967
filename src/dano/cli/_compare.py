"""`dano compare`."""

from dano import comparison
from dano.checks import checked_number
from dano.cli._arguments import Compare
from dano.cli._console import ProgressLine, put, put_json
from dano.cli._outputs import check_output
from dano.fields import AbstractShape, load_field
from dano.report import verdict, write_comparison_report
from dano.scene_file import load_object


def compare(arguments: Compare) -> None:
    """See `dano compare --help`."""
    inputs = [file for file in (arguments.object, arguments.field, arguments.truth) if file is not None]
    check_output(arguments.output, *inputs, suffix=".html")
    truth = None
    if arguments.truth_scale is not None:
        checked_number("truth_scale", arguments.truth_scale, above=0)
    if arguments.truth is not None:
        truth = load_field(arguments.truth, scale=arguments.truth_scale)
        if not isinstance(truth, AbstractShape):
            raise ValueError(
                f"truth must be a closed mesh or a signed distance, got a {type(truth).__name__} in"
                f" {arguments.truth}"
            )
    field = None if arguments.field is None else load_field(arguments.field)
    made = load_object(arguments.object)
    progress = ProgressLine()
    found = comparison.compare(
        made,
        field=field,
        truth=truth,
        progress=progress,
        levels=arguments.levels or None,
        drops=arguments.drops,
        decomposed=not arguments.no_decomposition,
        seed=arguments.seed,
    )
    progress.close()
    title = f"{arguments.object.stem}: meshes and the neural object"
    write_comparison_report(arguments.output, found, title=title)
    if arguments.json:
        rows = [row._asdict() for row in found.rows]
        page = str(arguments.output)
        put_json({**found._asdict(), "rows": rows, "scenery": len(found.scenery), "page": page})
        return
    for row in found.rows:
        level = "" if row.level != row.level else f" at {row.level:.3g}"
        put(f"{row.route + level:<44} {row.engine:<9} {verdict(row)}")
    for text in found.missing:
        put(text)
    put(f"wrote {arguments.output}")
