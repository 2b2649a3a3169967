"""Scene files: bodies, contacts, initial state and controls written in TOML.

A run remembers the text of the scene that it came from, so that it can be looked at again: see `save_run`.
"""

from dano.scene_file._check import (
    BodyLine as BodyLine,
    check_scene as check_scene,
    ContactLine as ContactLine,
    Cost as Cost,
    SceneCheck as SceneCheck,
)
from dano.scene_file._forecast import Finding as Finding, too_fast as too_fast
from dano.scene_file._objects import (
    asset_look as asset_look,
    ASSETS as ASSETS,
    build_asset as build_asset,
    build_object as build_object,
    is_shipped as is_shipped,
    load_asset as load_asset,
    load_object as load_object,
    object_look as object_look,
    object_of_file as object_of_file,
    Progress as Progress,
)
from dano.scene_file._parts import (
    build_parts as build_parts,
    materials_doubt as materials_doubt,
    Part as Part,
    part_of as part_of,
    parts_of as parts_of,
)
from dano.scene_file._reading import (
    load_scene as load_scene,
    parse_scene as parse_scene,
    SceneFile as SceneFile,
)
from dano.scene_file._runs import (
    drop_scene as drop_scene,
    load_run as load_run,
    Run as Run,
    run_piece as run_piece,
    save_run as save_run,
)
from dano.scene_file._schedule import Schedule as Schedule
from dano.scene_file._tasks import load_task as load_task, TaskFile as TaskFile
