"""Fields from files of many kinds, and files of fields."""

from dano.fields.readers._io import (
    companion_files as companion_files,
    FIELD_FORMATS as FIELD_FORMATS,
    FIELD_SUFFIXES as FIELD_SUFFIXES,
    load_field as load_field,
    offer_learned as offer_learned,
    save_field as save_field,
)
from dano.fields.readers._splats import is_splats as is_splats, read_splats as read_splats, Splats as Splats
