"""Inside compiled code a Bench is one pointer, not ninety arrays by value.

Numba passes a named tuple field by field and counts a reference to every array at each call; with a Bench that is most of a
tick and most of the compile time. `handle(bench)` copies the views once, before tick 0, into a reference object with the same
attribute names. Without the compiler it is the Bench itself, so the same functions run either way.
"""

import hashlib

from numba import types
from numba.core import cgutils
from numba.core.datamodel import default_manager, models
from numba.experimental import structref
from numba.experimental.jitclass.base import imp_dtor
from numba.extending import intrinsic, overload

import hilrunner.base.compiled  # noqa: F401  (chooses the cache folder first)

_BY_REFERENCE = (
    "Ring",
    "Mailbox",
    "CommandTable",
    "MeasurementTable",
)  # parts of a Bench that are handed on whole, so they get a handle of their own


class HandleType(types.StructRef):
    """A reference object with the fields of a named tuple."""

    def preprocess_fields(self, fields):
        """Fields keep their types, literals become plain."""
        return tuple((name, types.unliteral(kind)) for name, kind in fields)

    def __init__(self, fields):
        super().__init__(fields)
        # the spelt-out name is 20 kB; it would stand in every symbol of the loop and cost most of its compile time
        self.name = "Handle_" + hashlib.sha256(self.name.encode()).hexdigest()[:16]

    def get_data_type(self):
        """Type of the fields behind the pointer, its name shortened likewise."""
        payload = super().get_data_type()
        payload.name = self.name + "_payload"
        return payload


default_manager.register(HandleType, models.StructRefModel)
structref.define_attributes(HandleType)


def _field_type(kind):
    if isinstance(kind, types.NamedTuple) and kind.instance_class.__name__ in _BY_REFERENCE:
        return _handle_type(kind)
    return kind


def _handle_type(kind) -> HandleType:
    return HandleType(tuple((name, _field_type(inner)) for name, inner in zip(kind.fields, kind.types, strict=True)))


@intrinsic
def _new_handle(typing_context, values):
    """A HandleType object that holds the fields of a named tuple; each array is counted once, here."""

    def build(context, builder, source_type, source):
        kind = _handle_type(source_type)
        utils = structref._Utils(context, builder, kind)
        payload = context.data_model_manager[kind.get_data_type()].get_value_type()
        size = context.get_constant(types.uintp, context.get_abi_sizeof(payload))
        meminfo = context.nrt.meminfo_alloc_dtor(builder, size, imp_dtor(context, builder.module, kind))
        pointer = builder.bitcast(context.nrt.meminfo_data(builder, meminfo), payload.as_pointer())
        builder.store(cgutils.get_null_value(payload), pointer)
        value = utils.new_struct_ref(meminfo)._getvalue()
        data = utils.get_data_struct(value)
        for index, (name, inner) in enumerate(zip(source_type.fields, source_type.types, strict=True)):
            part = builder.extract_value(source, index)
            if _field_type(inner) is inner:
                context.nrt.incref(builder, inner, part)
            else:
                part = build(context, builder, inner, part)
            setattr(data, name, part)
        return value

    def codegen(context, builder, signature, args):
        return build(context, builder, values, args[0])

    return _handle_type(values)(values), codegen


def handle(values):
    """The fields of a named tuple behind one pointer (compiled), or the named tuple itself (interpreted)."""
    return values


@overload(handle)
def _handle_compiled(values):
    if isinstance(values, HandleType):
        return lambda values: values
    return lambda values: _new_handle(values)
