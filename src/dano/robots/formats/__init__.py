"""Robots' files: what they say, as plain numbers. One file a format."""

from dano.robots.formats._collada import read_collada as read_collada
from dano.robots.formats._description import (
    at_home as at_home,
    Connection as Connection,
    Description as Description,
    Drive as Drive,
    GeomPair as GeomPair,
    held_at as held_at,
    Keyframe as Keyframe,
    Lacking as Lacking,
    Link as Link,
    Placed as Placed,
    Solid as Solid,
    Tie as Tie,
    without_followers as without_followers,
)
from dano.robots.formats._lacking import (
    checked_ignore as checked_ignore,
    EQUALITIES as EQUALITIES,
    GRAVCOMP as GRAVCOMP,
    IGNORABLE as IGNORABLE,
    MASSES as MASSES,
    WEIGHTLESS as WEIGHTLESS,
)
from dano.robots.formats._mjcf import read_mjcf as read_mjcf
from dano.robots.formats._urdf import read_urdf as read_urdf, rotation_of as rotation_of
