"""Trained models: an ONNX file becomes the networks of an axis, or one clear error.

Read in this order: size and existence, protobuf, data outside the file, metadata (in the file, or `<file>.json` beside
it), graph to layers, numbers finite, plant parameters, and last a comparison of the compiled kernel with onnxruntime on
random points: golden vectors inside a file whose data sheet vouches for its hash, else onnxruntime itself.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilrunner.base.errors import ModelError
from hilrunner.plant.foreign_call import layout
from hilrunner.plant.head import KERNEL_NAMES
from hilrunner.plant.network import RECIPE_NAMES, ROLES, Mlp, SurrogateNetworks, assemble_bank, forward_many
from hilrunner.setup import model_file, model_rows, model_text
from hilrunner.setup.model_graph import Chain, Graph
from hilrunner.setup.model_onnxruntime import Part, bind, part_of, reasons
from hilrunner.setup.model_program import Program, finished, needs_program, program_of

COMPARED_POINTS = 256
DOUBLE_TOLERANCE_RATIO = 1e-10  # of the outputs' range over the compared points: rounding, nothing else
SINGLE_TOLERANCE_RATIO = 2e-5
PARAMETER_TOLERANCE_RATIO = 1e-9


@dataclass(frozen=True)
class ModelReport:
    """How a model was understood, for the terminal, the log and `hilrunner check`."""

    path: Path
    sha256: str
    circuit: str
    recipe: str
    lines: tuple[str, ...]  # one a network, then what was compared
    largest_difference_ratio: float  # compiled against onnxruntime, of the outputs' range

    def summary(self) -> str:
        """One line for a terminal."""
        return f"{self.path.name} ({self.circuit}, {self.recipe}; sha256 {self.sha256[:12]}): " + "; ".join(
            line.strip() for line in self.lines
        )

    def text(self) -> str:
        """Several lines for a terminal."""
        return "\n".join([f"model {self.path.name}: circuit {self.circuit}, recipe {self.recipe}", *self.lines])


def load_model(
    path: Path | model_file.ModelFile,
    circuit: str,
    parameters: np.ndarray | None = None,
    in_loop: bool = False,
    description: dict | None = None,
) -> tuple[SurrogateNetworks, ModelReport]:
    """The networks of one axis from an ONNX file.

    Args:
        path: the file, or what was read of it.
        circuit: status.CIRCUIT_NAMES; the file must be for it.
        parameters: PARAMETERS record (1,); what the networks were trained for must agree with it. None: not checked.
        in_loop: run the networks by onnxruntime (engine onnx) instead of the compiled kernels.
        description: `hil.*` keys from a profile; they win over the file's own.

    Raises:
        ModelError: anything about the file that is missing, damaged, foreign or does not agree.
    """
    file = path if isinstance(path, model_file.ModelFile) else model_file.read_model_file(Path(path))
    with model_file.damage_told(file.place), np.errstate(all="ignore"):  # numbers that are not finite are told in words
        return _load(file, circuit, parameters, in_loop, description)


def _load(
    file: model_file.ModelFile, circuit: str, parameters: np.ndarray | None, in_loop: bool, description: dict | None
) -> tuple[SurrogateNetworks, ModelReport]:
    place, digest = file.place, file.digest
    model, data = model_file.parse(file)
    vouched = file.vouched()
    text = model_text.read_text(place, model_file.properties(model, file.sheet(), description))
    if text.circuit != circuit:
        raise ModelError(place, f"is for circuit '{text.circuit}'", f"'{circuit}'", "name another model in the profile")
    if parameters is not None:
        _check_parameters(place, text, parameters)
    networks, lines = _networks(place, model, text, in_loop)
    keep_alive = None
    if in_loop:
        networks, keep_alive = bind(place, data, networks, text, trusted=vouched)
    worst, how = _compare(place, data, networks, text, vouched and bool(text.golden) and not in_loop, keep_alive)
    lines.append(f"  compiled against {how}: largest difference {worst:.1e} of the outputs' range")
    surrogate = SurrogateNetworks(
        recipe=RECIPE_NAMES.index(text.recipe),
        networks=networks,
        circuit=text.circuit,
        source=f"{file.name} sha256 {digest}",
        keep_alive=keep_alive,
    )
    return surrogate, ModelReport(Path(file.name), digest, text.circuit, text.recipe, tuple(lines), worst)


def _check_parameters(place: str, text: model_text.ModelText, parameters: np.ndarray) -> None:
    from hilrunner.plant.parameters import SPEC_BY_KEY

    for key, trained in text.parameters.items():
        row = SPEC_BY_KEY.get(key)
        if row is None:
            raise ModelError(place, f"was trained for '{key}', which no plant has", remedy="train it again")
        if isinstance(trained, bool) or not isinstance(trained, int | float) or not math.isfinite(trained):
            raise ModelError(place, f"says in {model_text.KEY_PARAMETERS} that {key} is {trained!r}", "a finite number")
        actual = float(parameters[row.field][0]) / row.factor
        if abs(actual - trained) > PARAMETER_TOLERANCE_RATIO * max(abs(actual), abs(trained)):
            raise ModelError(
                place,
                f"was trained for {key} = {trained:g}, the profile has {actual:g}",
                f"{trained:g}",
                "hilrunner train --profile on this profile, or --engine reference",
            )


def _networks(place: str, model, text: model_text.ModelText, in_loop: bool) -> tuple[dict[str, Mlp], list[str]]:
    graph = Graph(place, model)
    networks, lines = {}, []
    for network in text.networks:
        output = network.output or graph.outputs[0]
        if output not in graph.outputs:
            raise ModelError(place, f"has no output '{output}'", ", ".join(graph.outputs))
        if in_loop:
            networks[network.role] = _opaque(network, text)
            lines.append(f"  {network.role}: run by onnxruntime, {len(network.inputs)} -> {len(network.outputs)}")
            continue
        chain, last = program_of(graph, output) if needs_program(graph, output) else (graph.chain(output), None)
        if network.input and chain.input != network.input:
            raise ModelError(place, f"output '{output}' comes from input '{chain.input}'", f"'{network.input}'")
        if last is None:
            mlp = _in_si(place, chain, network, text)
        else:
            mlp = _program_in_si(place, chain, last, network, text)
        _check_finite(place, network.role, mlp)
        networks[network.role] = mlp
        lines.append(
            f"  {network.role}: {chain.describe()}, {mlp.parameter_count} parameters, {KERNEL_NAMES[mlp.kernel]} kernel"
        )
    return networks, lines


def _factors(quantities: tuple[dict, ...]) -> np.ndarray:
    return np.array([model_text.UNITS[quantity["unit"]] for quantity in quantities])


def _order(network: model_text.NetworkText, text: model_text.ModelText) -> tuple[list[int], list[int]]:
    """Columns of the file's inputs and outputs in the order the reduced model uses."""
    _, inputs, outputs = model_text.form_of(text.circuit, text.recipe, network)
    orders = []
    for quantities, names in ((network.inputs, inputs), (network.outputs, outputs)):
        have = [model_text.stem(quantity["name"]) for quantity in quantities]
        orders.append([have.index(name) for name in names])
    return orders[0], orders[1]


def _ranges(network: model_text.NetworkText, order: list[int]) -> tuple[np.ndarray, np.ndarray]:
    factors = _factors(network.inputs)
    low = np.array([quantity["low"] for quantity in network.inputs]) * factors
    high = np.array([quantity["high"] for quantity in network.inputs]) * factors
    return low[order], high[order]


def _in_si(place: str, chain: Chain, network: model_text.NetworkText, text: model_text.ModelText) -> Mlp:
    """A chain with its units turned into SI and its columns into the reduced model's order."""
    widths = (chain.input_count, len(chain.biases[-1]))
    _check_widths(place, network, widths)
    inputs, outputs = _order(network, text)
    in_factor, out_factor = _factors(network.inputs), _factors(network.outputs)
    full = np.ones(widths[0])
    offset = (full * (chain.input_offset if chain.input_offset is not None else 0.0)) * in_factor
    scale = (full * (chain.input_scale if chain.input_scale is not None else 1.0)) / in_factor
    out_scale = np.ones(widths[1]) * (chain.scale if chain.scale is not None else 1.0) * out_factor
    out_offset = np.ones(widths[1]) * (chain.offset if chain.offset is not None else 0.0) * out_factor
    low, high = _ranges(network, inputs)
    weights, biases = list(chain.weights), list(chain.biases)
    weights[0] = np.ascontiguousarray(weights[0][:, inputs])
    weights[-1], biases[-1] = np.ascontiguousarray(weights[-1][outputs]), biases[-1][outputs]
    return Mlp(
        weights=tuple(weights),
        biases=tuple(biases),
        activations=tuple(chain.activations),
        input_offset=offset[inputs],
        input_scale=scale[inputs],
        output_scale=out_scale[outputs],
        output_offset=out_offset[outputs],
        input_low=low,
        input_high=high,
        input_names=tuple(network.inputs[column]["name"] for column in inputs),
        output_names=tuple(network.outputs[column]["name"] for column in outputs),
        form=model_text.form_of(text.circuit, text.recipe, network)[0],
    )


def _check_widths(place: str, network: model_text.NetworkText, widths: tuple[int, int]) -> None:
    named = (len(network.inputs), len(network.outputs))
    if widths != named:
        raise ModelError(
            f"{place}: network '{network.role}'",
            f"takes {widths[0]} and gives {widths[1]} numbers, its metadata names {named[0]} and {named[1]}",
            "the same width",
        )


def _program_in_si(place: str, program: Program, last: int, network: model_text.NetworkText, text) -> Mlp:
    """A network with branches, its units turned into SI and its columns into the reduced model's order."""
    _check_widths(place, network, (program.input_count, program.output_count))
    inputs, outputs = _order(network, text)
    low, high = _ranges(network, inputs)
    words = finished(program, last, inputs, _factors(network.inputs), outputs, _factors(network.outputs))
    ones_in, ones_out = np.ones(len(inputs)), np.ones(len(outputs))
    return Mlp(
        (), (), (), 0.0 * ones_in, ones_in, ones_out, 0.0 * ones_out, low, high,
        input_names=tuple(network.inputs[column]["name"] for column in inputs),
        output_names=tuple(network.outputs[column]["name"] for column in outputs),
        form=model_text.form_of(text.circuit, text.recipe, network)[0],
        program=words,
    )  # fmt: skip


def _opaque(network: model_text.NetworkText, text: model_text.ModelText) -> Mlp:
    """A network known by its ends only, for onnxruntime."""
    inputs, outputs = _order(network, text)
    low, high = _ranges(network, inputs)
    ones_in, ones_out = np.ones(len(inputs)), np.ones(len(outputs))
    return Mlp(
        (), (), (), 0.0 * ones_in, ones_in, ones_out, 0.0 * ones_out, low, high,
        foreign_layout=layout(inputs, _factors(network.inputs), outputs, _factors(network.outputs)),
        form=model_text.form_of(text.circuit, text.recipe, network)[0],
    )  # fmt: skip


def _check_finite(place: str, role: str, mlp: Mlp) -> None:
    named = [(f"weight of layer {i}", value) for i, value in enumerate(mlp.weights)]
    named += [(f"bias of layer {i}", value) for i, value in enumerate(mlp.biases)]
    named += [("input scaling", mlp.input_scale), ("input offset", mlp.input_offset)]
    named += [("output scaling", mlp.output_scale), ("output offset", mlp.output_offset)]
    named += [] if mlp.program is None else [("constants", mlp.program)]
    for name, value in named:
        bad = np.count_nonzero(~np.isfinite(value))
        if bad:
            raise ModelError(
                f"{place}: network '{role}'", f"{bad} of {value.size} numbers of its {name} are not finite", "numbers"
            )


def _compare(
    place: str, data: bytes, networks: dict[str, Mlp], text, golden: bool, bound: list | None
) -> tuple[float, str]:
    """Largest difference between what the axis will evaluate and onnxruntime, over the outputs' range; how it was found."""
    bank = assemble_bank([SurrogateNetworks(1, networks, text.circuit)])
    worst = 0.0
    for network in text.networks:
        mlp = networks[network.role]
        if golden:
            inputs, expected = _golden(place, network, text)
            tolerance = DOUBLE_TOLERANCE_RATIO
        else:
            inputs, expected, tolerance = _ask(place, part_of(place, data, network), network, text)
        outputs = np.zeros((len(inputs), mlp.output_count))
        start = bank.axis_start[0, ROLES[network.role]]
        failures = forward_many(bank.words, start, inputs, outputs)
        if failures and bound is not None:
            raise ModelError(
                place,
                f"{failures} of {len(inputs)} evaluations failed: {'; '.join(reasons(bound)) or 'no reason is told'}",
                remedy="a model that answers one point at a time, or --engine surrogate",
            )
        span = np.maximum(np.ptp(expected, axis=0), 1e-300)
        with np.errstate(invalid="ignore", over="ignore"):
            difference = float(np.max(np.abs(outputs - expected) / span))
        if failures or not difference <= tolerance:
            raise ModelError(
                f"{place}: network '{network.role}'",
                f"compiled and onnxruntime outputs differ by {difference:.1e} of their range"
                + (f", {failures} evaluations failed" if failures else ""),
                f"at most {tolerance:g}",
                "report this file; --engine onnx runs it as onnxruntime does",
            )
        worst = max(worst, difference)
    how = f"{GOLDEN_WORDS} ({len(inputs)} points)" if golden else f"onnxruntime ({COMPARED_POINTS} points)"
    return worst, how


GOLDEN_WORDS = "onnxruntime's golden vectors"


def _session(place: str, data: bytes):
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's error classes have no common base but Exception
        words = str(error).splitlines()[0]
        remedy = "export it in float32: some nodes have no other" if "NOT_IMPLEMENTED" in words else "export it again"
        raise ModelError(place, f"onnxruntime refuses it: {words}", remedy=remedy) from error


def _ask(place: str, part: Part, network: model_text.NetworkText, text) -> tuple[np.ndarray, np.ndarray, float]:
    """Random points of the training range in the reduced model's order and SI, and onnxruntime's answers to them."""
    inputs, outputs = _order(network, text)
    low = np.array([quantity["low"] for quantity in network.inputs], float)
    high = np.array([quantity["high"] for quantity in network.inputs], float)
    raw = np.random.default_rng(0).uniform(low, high, (COMPARED_POINTS, len(low)))
    single = part.rows.kind == np.float32
    if single:
        raw = raw.astype(np.float32).astype(np.float64)
    where = f"{place}: network '{network.role}'"
    session = _session(place, part.data)
    try:
        answer = model_rows.ask(session, part.rows, part.output, raw)
    except Exception as error:  # as in `_session`
        problem = f"onnxruntime cannot run it: {(str(error).strip() or type(error).__name__).splitlines()[0]}"
        raise ModelError(where, problem, remedy="export it again, with one row as its example") from error
    if answer.shape[1] != len(network.outputs):
        raise ModelError(
            where, f"answers {answer.shape[1]} numbers, its metadata names {len(network.outputs)}", "the same number"
        )
    in_si = raw * _factors(network.inputs)
    out_si = answer * _factors(network.outputs)
    return in_si[:, inputs], out_si[:, outputs], SINGLE_TOLERANCE_RATIO if single else DOUBLE_TOLERANCE_RATIO


def _golden(place: str, network: model_text.NetworkText, text) -> tuple[np.ndarray, np.ndarray]:
    """The golden vectors of a network, in the reduced model's order and SI."""
    try:
        vectors = text.golden[network.role]
        inputs, outputs = np.array(vectors["inputs"], float), np.array(vectors["outputs"], float)
        shapes = (len(network.inputs), len(network.outputs))
        if (
            inputs.ndim == outputs.ndim == 2
            and (inputs.shape[1], outputs.shape[1]) == shapes
            and len(inputs) == len(outputs) > 0
        ):
            return inputs, outputs
    except (KeyError, TypeError, ValueError):
        pass
    raise ModelError(
        f"{place}: network '{network.role}'", f"{model_text.KEY_GOLDEN} holds no points with answers of its width",
        "inputs and outputs, a row a point", "export it again",
    )  # fmt: skip
