"""Define the base class of all sections of a configuration."""

from collections.abc import Iterator

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """Base class of all sections: immutable, with strict types and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    def __repr_args__(self) -> Iterator[tuple[str | None, object]]:
        """Yield only the settings that differ from the defaults, so that the text stays short."""
        for name, field in type(self).model_fields.items():
            if (value := getattr(self, name)) != field.get_default(call_default_factory=True):
                yield name, value
