"""Logs as they are recorded: tables of text, what their columns mean, and what has to be corrected."""

from dano.identification.logs._columns import Columns as Columns, understood as understood
from dano.identification.logs._mending import (
    in_metres as in_metres,
    LENGTH_UNITS as LENGTH_UNITS,
    mended_times as mended_times,
    ordered_quaternions as ordered_quaternions,
    TIME_UNITS as TIME_UNITS,
    unwrapped as unwrapped,
)
from dano.identification.logs._table import read_table as read_table, Table as Table
