"""Objects, and robots, in the formats of other simulators: meshes, MJCF, URDF, USD."""

from dano.exchange._export import (
    check_folder as check_folder,
    export_object as export_object,
    Exported as Exported,
    ExportOptions as ExportOptions,
    Format as Format,
)
from dano.exchange._robots import export_robot as export_robot
from dano.exchange._triangles import (
    Collision as Collision,
    convex_hull as convex_hull,
    decomposition as decomposition,
    enclosed as enclosed,
    largest_part as largest_part,
    level_triangles as level_triangles,
    Moments as Moments,
    signed_distances as signed_distances,
    solid_triangles as solid_triangles,
    Triangles as Triangles,
)
from dano.exchange._wavefront import write_obj as write_obj
