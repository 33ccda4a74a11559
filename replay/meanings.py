"""What the fields of records mean: the text below each, read where it is printed.

Reading the source of every class takes longer than replaying a short drive, so only schemas and
documentation do.
"""

import ast
import inspect
from itertools import pairwise
from textwrap import dedent

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import ModelSchema


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """Return the text below each field of a record, by the field's name."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if base is BaseModel or not issubclass(base, BaseModel):
            continue
        [tree] = ast.parse(dedent(inspect.getsource(base))).body
        assert isinstance(tree, ast.ClassDef)
        for above, below in pairwise(tree.body):
            match above, below:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    found[name] = inspect.cleandoc(text)
    return found


class SchemaWithMeanings(GenerateJsonSchema):
    """JSON Schema whose properties are described by the texts below the fields."""

    def model_schema(self, schema: ModelSchema) -> JsonSchemaValue:
        """Return the schema of a record."""
        found = super().model_schema(schema)
        model = schema["cls"]
        shown, texts = found.get("properties", {}), meanings(model)
        for name, field in model.model_fields.items():
            # A field that is not written, and a record with a serializer of its own, are not shown.
            key = field.serialization_alias or name
            if name in texts and key in shown:
                shown[key].setdefault("description", texts[name])
        return found
