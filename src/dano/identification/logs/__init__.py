"""Logs as they are recorded: tables of text, what their columns mean, and what has to be corrected."""

from dano.identification.logs._table import (
    Columns as Columns,
    in_metres as in_metres,
    LENGTH_UNITS as LENGTH_UNITS,
    LogTable as LogTable,
    mended_times as mended_times,
    ordered_quaternions as ordered_quaternions,
    read_table as read_table,
    TIME_UNITS as TIME_UNITS,
    understood as understood,
    unwrapped as unwrapped,
)
