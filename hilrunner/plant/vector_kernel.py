"""The [25, 10, 20] tanh network as vector machine code: one LLVM function, any CPU, weights in memory.

Each layer is a sum of columns (weight column times one broadcast activation); the rows of a column fill whole
vectors of LANES float64, so nothing is gathered. Several partial sums per layer hide the latency of the fused
multiply-add. LLVM legalises the vector width for the CPU at hand (AVX-512: 8 lanes at once, AVX2: 4, NEON: 2 x 2).

tanh is that of plant.tanh; its factor 2/ln 2 is folded into the packed weights, so f is exact there. Absolute error below
3e-16 (tested).
"""

import numpy as np
from llvmlite import ir

from hilrunner.base import compiled  # noqa: F401  (sets the cache folder before numba loads)
from hilrunner.plant.tanh import P0, P1, PRESCALE, Q0, Q1, Q2, ROUNDING

from numba import config, types  # isort: skip
from numba.core import cgutils  # isort: skip
from numba.core.registry import cpu_target  # isort: skip
from numba.extending import intrinsic  # isort: skip

HIDDEN = (25, 10, 20)
MAX_INPUTS = 8
MAX_OUTPUTS = 8
PARTIAL_SUMS = (1, 4, 2)  # per layer; the first layer has enough rows to hide the latency by itself
SATURATION = 64.0  # 2^64: tanh is 1 to the last bit


def host_lanes() -> int:
    """Lanes of float64 a vector of the compiled code has; part of the layout of the packed weights.

    Taken from the features Numba compiles for, which are also part of the key of its disk cache.
    """
    features = cpu_target.target_context.codegen().magic_tuple()[2].split(",")
    return 8 if "+avx512f" in features else 4


LANES = host_lanes()


def padded(rows: int, lanes: int = LANES) -> int:
    """Rows rounded up to whole vectors."""
    return -(-rows // lanes) * lanes


def pack(weights, biases, input_offset, input_scale, output_scale, output_offset, lanes: int = LANES) -> np.ndarray:
    """The network's numbers in the order the kernel reads them, float64[n].

    Args:
        weights: four float64[out, in] arrays, hidden sizes HIDDEN.
        biases: four float64[out] arrays.
        input_offset, input_scale: float64[inputs]; the first layer sees (x - offset) * scale.
        output_scale, output_offset: float64[outputs]; y = sum * scale + offset.
    """
    parts = []
    for bias, rows in zip(biases[:3], HIDDEN, strict=True):
        parts.append(_pad(bias * PRESCALE, rows, lanes))
    for layer in (1, 2):
        for column in (weights[layer] * PRESCALE).T:
            parts.append(_pad(column, HIDDEN[layer], lanes))
    for values in (input_offset, input_scale):
        parts.append(_pad(np.asarray(values, float), MAX_INPUTS, 1))
    for values in (biases[3], output_scale, output_offset):
        parts.append(_pad(np.asarray(values, float), MAX_OUTPUTS, 1))
    for column in _pad_columns(weights[0] * PRESCALE).T:
        parts.append(_pad(column, HIDDEN[0], lanes))
    for row in weights[3]:
        parts.append(_pad(row, HIDDEN[2], lanes))
    return np.concatenate(parts)


def _pad(values: np.ndarray, rows: int, lanes: int) -> np.ndarray:
    out = np.zeros(padded(rows, lanes))
    out[: len(values)] = values
    return out


def _pad_columns(matrix: np.ndarray) -> np.ndarray:
    out = np.zeros((matrix.shape[0], MAX_INPUTS))
    out[:, : matrix.shape[1]] = matrix
    return out


def offsets(lanes: int = LANES) -> dict[str, int]:
    """Where each part of the packed numbers starts, in float64 words."""
    sizes = [
        ("bias_1", padded(HIDDEN[0], lanes)),
        ("bias_2", padded(HIDDEN[1], lanes)),
        ("bias_3", padded(HIDDEN[2], lanes)),
        ("columns_2", HIDDEN[0] * padded(HIDDEN[1], lanes)),
        ("columns_3", HIDDEN[1] * padded(HIDDEN[2], lanes)),
        ("input_offset", MAX_INPUTS),
        ("input_scale", MAX_INPUTS),
        ("bias_4", MAX_OUTPUTS),
        ("output_scale", MAX_OUTPUTS),
        ("output_offset", MAX_OUTPUTS),
        ("columns_1", MAX_INPUTS * padded(HIDDEN[0], lanes)),
        ("rows_4", 0),
    ]
    starts, position = {}, 0
    for name, size in sizes:
        starts[name] = position
        position += size
    return starts


class _Emitter:
    """Writes the kernel's LLVM IR; `lanes` float64 to a vector."""

    def __init__(self, module: ir.Module, lanes: int) -> None:
        self.double = ir.DoubleType()
        self.word = ir.IntType(64)
        self.vector = ir.VectorType(self.double, lanes)
        self.words = ir.VectorType(self.word, lanes)
        self.lanes = lanes
        self.at = offsets(lanes)
        self.vectors = [padded(rows, lanes) // lanes for rows in HIDDEN]
        pointer = self.double.as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer, pointer, pointer, self.word, self.word])
        name = f"hilrunner_mlp_{'_'.join(map(str, HIDDEN))}_{lanes}"
        self.function = cgutils.get_or_insert_function(module, kind, name)
        self.module = module

    def write(self) -> ir.Function:
        """The function, its body written once a module."""
        if self.function.blocks:
            return self.function
        self.function.linkage = "linkonce_odr"
        self.function.attributes.add("noinline")
        self.function.attributes.add("nounwind")
        for name, argument in zip("wxyio", self.function.args, strict=True):
            argument.name = name
        self.b = ir.IRBuilder(self.function.append_basic_block("entry"))
        self.weights, self.x, self.y, self.inputs, self.outputs = self.function.args
        first = self.first_layer()
        second = self.hidden_layer(first, HIDDEN[0], "bias_2", "columns_2", self.vectors[1], PARTIAL_SUMS[1])
        third = self.hidden_layer(second, HIDDEN[1], "bias_3", "columns_3", self.vectors[2], PARTIAL_SUMS[2])
        self.output_layer(third)
        self.b.ret_void()
        return self.function

    # -- pieces ---------------------------------------------------------------------------------------------------

    def constant(self, value: float):
        return ir.Constant(self.vector, [ir.Constant(self.double, value)] * self.lanes)

    def call(self, name: str, *arguments):
        kind = arguments[0].type
        signature = ir.FunctionType(kind, [kind] * len(arguments))
        function = cgutils.get_or_insert_function(self.module, signature, f"{name}.v{self.lanes}f64")
        return self.b.call(function, arguments)

    def fma(self, a, b, c):
        # fmuladd: fused where the CPU can, multiply and add where it cannot (a library call would be far slower)
        return self.call("llvm.fmuladd", a, b, c)

    def load_scalar(self, pointer, index):
        index = ir.Constant(self.word, index) if isinstance(index, int) else index
        return self.b.load(self.b.gep(pointer, [index]))

    def load_vector(self, index):
        index = ir.Constant(self.word, index) if isinstance(index, int) else index
        pointer = self.b.bitcast(self.b.gep(self.weights, [index]), self.vector.as_pointer())
        load = self.b.load(pointer)
        load.align = 8
        return load

    def splat(self, scalar):
        one = self.b.insert_element(ir.Constant(self.vector, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
        return self.broadcast(one, 0)

    def broadcast(self, vector, lane: int):
        mask = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), [lane] * self.lanes)
        return self.b.shuffle_vector(vector, ir.Constant(self.vector, ir.Undefined), mask)

    def tanh(self, t):
        """tanh(t / PRESCALE), lane by lane; a NaN stays a NaN."""
        b = self.b
        low, high = self.constant(-SATURATION), self.constant(SATURATION)
        t = b.select(b.fcmp_ordered("<", t, low), low, t)
        t = b.select(b.fcmp_ordered(">", t, high), high, t)
        shifted = b.fadd(t, self.constant(ROUNDING))
        f = b.fsub(t, b.fsub(shifted, self.constant(ROUNDING)))
        s = b.fmul(f, f)
        p = self.fma(b.fadd(s, self.constant(P1)), s, self.constant(P0))
        q = self.fma(self.fma(s, self.constant(Q2), self.constant(Q1)), s, self.constant(Q0))
        above = self.fma(f, p, q)
        below = self.fma(b.fneg(f), p, q)
        shift = ir.Constant(self.words, [ir.Constant(self.word, 52)] * self.lanes)
        exponent = b.shl(b.bitcast(shifted, self.words), shift)
        grown = b.bitcast(b.add(b.bitcast(above, self.words), exponent), self.vector)
        return b.fdiv(b.fsub(grown, below), b.fadd(grown, below))

    def first_layer(self):
        """Scale the inputs and sum their columns; the number of inputs is known at run time only."""
        b, count = self.b, self.vectors[0]
        start = [self.load_vector(self.at["bias_1"] + v * self.lanes) for v in range(count)]
        entry = b.block
        loop, done = self.function.append_basic_block("input"), self.function.append_basic_block("first_layer")
        b.branch(loop)
        b.position_at_end(loop)
        j = b.phi(self.word)
        sums = [b.phi(self.vector) for _ in range(count)]
        offset = self.load_scalar(self.weights, b.add(j, ir.Constant(self.word, self.at["input_offset"])))
        scale = self.load_scalar(self.weights, b.add(j, ir.Constant(self.word, self.at["input_scale"])))
        z = self.splat(b.fmul(b.fsub(self.load_scalar(self.x, j), offset), scale))
        rows = count * self.lanes
        column = b.add(b.mul(j, ir.Constant(self.word, rows)), ir.Constant(self.word, self.at["columns_1"]))
        after = []
        for v in range(count):
            weight = self.load_vector(b.add(column, ir.Constant(self.word, v * self.lanes)))
            after.append(self.fma(weight, z, sums[v]))
        following = b.add(j, ir.Constant(self.word, 1))
        b.cbranch(b.icmp_signed("<", following, self.inputs), loop, done)
        j.add_incoming(ir.Constant(self.word, 0), entry)
        j.add_incoming(following, loop)
        for phi, first, last in zip(sums, start, after, strict=True):
            phi.add_incoming(first, entry)
            phi.add_incoming(last, loop)
        b.position_at_end(done)
        return [self.tanh(value) for value in after]

    def hidden_layer(self, values, inputs: int, bias: str, columns: str, count: int, partial: int):
        """tanh of bias plus the sum over `inputs` broadcast activations of their weight columns."""
        sums = [[None] * count for _ in range(partial)]
        sums[0] = [self.load_vector(self.at[bias] + v * self.lanes) for v in range(count)]
        for j in range(inputs):
            z = self.broadcast(values[j // self.lanes], j % self.lanes)
            mine = sums[j % partial]
            for v in range(count):
                weight = self.load_vector(self.at[columns] + (j * count + v) * self.lanes)
                mine[v] = self.b.fmul(weight, z) if mine[v] is None else self.fma(weight, z, mine[v])
        out = []
        for v in range(count):
            total = [s[v] for s in sums]
            while len(total) > 1:
                total = [self.b.fadd(a, c) for a, c in zip(total[::2], total[1::2], strict=True)]
            out.append(self.tanh(total[0]))
        return out

    def output_layer(self, values):
        """One dot product an output; the number of outputs is known at run time only."""
        b, count = self.b, self.vectors[2]
        entry = b.block
        loop, done = self.function.append_basic_block("output"), self.function.append_basic_block("done")
        b.branch(loop)
        b.position_at_end(loop)
        i = b.phi(self.word)
        row = b.add(b.mul(i, ir.Constant(self.word, count * self.lanes)), ir.Constant(self.word, self.at["rows_4"]))
        total = None
        for v in range(count):
            weight = self.load_vector(b.add(row, ir.Constant(self.word, v * self.lanes)))
            total = b.fmul(weight, values[v]) if total is None else self.fma(weight, values[v], total)
        result = self.sum_lanes(total)
        bias, scale, offset = (
            self.load_scalar(self.weights, b.add(i, ir.Constant(self.word, self.at[name])))
            for name in ("bias_4", "output_scale", "output_offset")
        )
        result = b.fadd(b.fmul(b.fadd(result, bias), scale), offset)
        b.store(result, b.gep(self.y, [i]))
        following = b.add(i, ir.Constant(self.word, 1))
        b.cbranch(b.icmp_signed("<", following, self.outputs), loop, done)
        i.add_incoming(ir.Constant(self.word, 0), entry)
        i.add_incoming(following, loop)
        b.position_at_end(done)

    def sum_lanes(self, vector):
        b = self.b
        lanes = [b.extract_element(vector, ir.Constant(ir.IntType(32), lane)) for lane in range(self.lanes)]
        while len(lanes) > 1:
            half = len(lanes) // 2
            lanes = [b.fadd(a, c) for a, c in zip(lanes[:half], lanes[half:], strict=True)]
        return lanes[0]


def make_forward(lanes: int):
    """For compiled code: (packed, x, y: pointers to float64, inputs, outputs) -> 0; `lanes` float64 to a vector."""

    @intrinsic
    def forward_vector(typing, packed, x, y, inputs, outputs):
        pointer = types.CPointer(types.float64)
        signature = types.int64(pointer, pointer, pointer, types.int64, types.int64)

        def generate(context, builder, sig, arguments):
            function = _Emitter(builder.module, lanes).write()
            builder.call(function, arguments)
            return ir.Constant(ir.IntType(64), 0)

        return signature, generate

    return forward_vector


forward_vector = None if config.DISABLE_JIT else make_forward(LANES)


def forward_interpreted(words, start, x, x_at, y, y_at, inputs, outputs):
    """The same network in numpy, for NUMBA_DISABLE_JIT=1; equal to the compiled one to rounding."""
    at = offsets(LANES)

    def take(name, rows):
        return words[start + at[name] : start + at[name] + rows]

    def columns(name, rows, count):
        return take(name, padded(rows) * count).reshape(count, padded(rows))[:, :rows].T

    values = (x[x_at : x_at + inputs] - take("input_offset", inputs)) * take("input_scale", inputs)
    layers = (("bias_1", "columns_1", inputs), ("bias_2", "columns_2", HIDDEN[0]), ("bias_3", "columns_3", HIDDEN[1]))
    for rows, (bias, name, count) in zip(HIDDEN, layers, strict=True):
        values = np.tanh((take(bias, rows) + columns(name, rows, count) @ values) / PRESCALE)
    total = columns("rows_4", HIDDEN[2], outputs).T @ values + take("bias_4", outputs)
    y[y_at : y_at + outputs] = total * take("output_scale", outputs) + take("output_offset", outputs)
    return 0
