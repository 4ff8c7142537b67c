"""Names a model file uses: metadata keys, the quantities each network role expects, and units with their factors to SI."""

import json
from dataclasses import dataclass

from hilrunner.base.errors import ModelError
from hilrunner.plant.head import FORM_PINNED, FORM_PLAIN, FORM_SHARE, MAX_QUANTITIES

FORMAT = "1"
_LARGEST = 1e15  # of a training range, in the quantity's own unit
KEY_FORMAT = "hil.format"
KEY_CIRCUIT = "hil.circuit"
KEY_RECIPE = "hil.recipe"
KEY_NETWORKS = "hil.networks"  # JSON: role, input, output, inputs [{name, unit, low, high}], outputs [{name, unit}]
KEY_PARAMETERS = "hil.parameters"  # JSON: profile keys and values the network was trained for
KEY_TRAINING = "hil.training"  # JSON: seed, points, versions, errors
KEY_GOLDEN = "hil.golden"  # JSON by role: inputs and outputs computed by onnxruntime at export
KEY_WEIGHTS_SHA256 = "hil.weights_sha256"

UNITS = {
    "Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "bar": 1e5,
    "m": 1.0, "mm": 1e-3, "m/s": 1.0, "mm/s": 1e-3,
    "m^3/s": 1.0, "mm^3/s": 1e-9, "L/min": 1e-3 / 60.0,
    "Pa/s": 1.0, "MPa/s": 1e6, "bar/s": 1e5,
    "1": 1.0, "%": 1e-2,
    "Pa^(1/2)": 1.0, "Pa^(1/4)": 1.0,
}  # fmt: skip

# what the reduced model hands to a network and takes from it, by circuit, recipe and role: (FORM_*, inputs, outputs), names
# without their unit. Where several stand, a file uses one of them.
_FLOWS = ("flow_1_per_command", "flow_2_per_command")
_PLAIN = ("chamber_1_pressure", "chamber_2_pressure", "valve_command", "spool_opening")
_Forms = tuple[tuple[int, tuple[str, ...], tuple[str, ...]], ...]
ROLE_FORMS: dict[tuple[str, str, str], _Forms] = {
    ("lift", "flow", "supply"): ((0, ("demand_root", "spool_share", "supply_drop"), ("line_over_chamber",)),),
    ("lift", "flow", "return"): ((0, ("chamber_root", "spool_share"), ("line_root",)),),
    ("paper", "flow", "flow"): (
        (FORM_SHARE, ("chamber_1_pressure", "chamber_2_root", "spool_share"), _FLOWS),
        (FORM_PINNED, _PLAIN[:3], _FLOWS),
        (FORM_PLAIN, _PLAIN, _FLOWS),
    ),
    ("paper", "paper", "rates"): (
        (
            0,
            ("rod_position", "rod_velocity", "chamber_1_pressure", "chamber_2_pressure", "valve_command"),
            ("chamber_1_pressure_rate", "chamber_2_pressure_rate"),
        ),
    ),
}
REQUIRED_ROLES = {("lift", "flow"): ("supply", "return"), ("paper", "flow"): ("flow",), ("paper", "paper"): ("rates",)}
_UNIT_ENDINGS = (
    "_mm3ps", "_m3ps", "_lpmin", "_mmps", "_mps", "_mpaps", "_paps", "_barps", "_mpa", "_kpa", "_bar", "_sqrtpa",
    "_pa", "_mm", "_m", "_ratio", "_percent",
)  # fmt: skip


def stem(name: str) -> str:
    """A quantity's name without its unit: `chamber_1_pressure_mpa` -> `chamber_1_pressure`."""
    for ending in _UNIT_ENDINGS:
        if name.endswith(ending):
            return name[: -len(ending)]
    return name


@dataclass(frozen=True)
class NetworkText:
    """What a file says of one of its networks."""

    role: str
    input: str  # graph input; empty: the only one
    output: str
    inputs: tuple[dict, ...]  # name, unit, low, high
    outputs: tuple[dict, ...]


@dataclass(frozen=True)
class ModelText:
    """What a file (or a description beside it, or the profile) says of its networks."""

    circuit: str
    recipe: str
    networks: tuple[NetworkText, ...]
    parameters: dict[str, float]
    golden: dict[str, dict]
    training: dict


def read_text(place: str, properties: dict[str, str]) -> ModelText:
    """The `hil.*` properties of a model, checked.

    Raises:
        ModelError: a key is missing, is not JSON, or names a circuit, recipe, role, quantity or unit that is unknown.
    """
    missing = [key for key in (KEY_CIRCUIT, KEY_RECIPE, KEY_NETWORKS) if key not in properties]
    if missing:
        raise ModelError(
            place,
            f"no metadata {', '.join(missing)}: nothing says what its inputs and outputs are",
            "metadata_props as in docs/surrogate.md",
            f"write them into the file, or into a description beside it ({place.rsplit('/', 1)[-1]}.json)",
        )
    if properties.get(KEY_FORMAT, FORMAT) != FORMAT:
        raise ModelError(place, f"metadata format {properties[KEY_FORMAT]}", FORMAT, "export it again")
    circuit, recipe = properties[KEY_CIRCUIT], properties[KEY_RECIPE]
    if (circuit, recipe) not in REQUIRED_ROLES:
        known = ", ".join(f"{c}/{r}" for c, r in REQUIRED_ROLES)
        raise ModelError(place, f"circuit '{circuit}' with recipe '{recipe}' is unknown", known)
    networks = tuple(_network(place, circuit, recipe, entry) for entry in _json(place, properties, KEY_NETWORKS, list))
    roles = [network.role for network in networks]
    for role in REQUIRED_ROLES[circuit, recipe]:
        if roles.count(role) != 1:
            raise ModelError(place, f"{roles.count(role)} networks for role '{role}'", "exactly one")
    return ModelText(
        circuit,
        recipe,
        networks,
        _json(place, properties, KEY_PARAMETERS, dict) if KEY_PARAMETERS in properties else {},
        _json(place, properties, KEY_GOLDEN, dict) if KEY_GOLDEN in properties else {},
        _json(place, properties, KEY_TRAINING, dict) if KEY_TRAINING in properties else {},
    )


def _json(place: str, properties: dict[str, str], key: str, kind: type):
    try:
        value = json.loads(properties[key])
    except (ValueError, RecursionError) as error:
        raise ModelError(place, f"metadata {key} is not JSON: {error}") from error
    if not isinstance(value, kind):
        raise ModelError(place, f"metadata {key} is a JSON {type(value).__name__}", kind.__name__)
    return value


def _network(place: str, circuit: str, recipe: str, entry: dict) -> NetworkText:
    role = str(entry.get("role", "")) if isinstance(entry, dict) else ""
    forms = ROLE_FORMS.get((circuit, recipe, role))
    if forms is None:
        known = ", ".join(r for c, n, r in ROLE_FORMS if (c, n) == (circuit, recipe))
        raise ModelError(place, f"role '{role}' is unknown for {circuit}/{recipe}", known)
    lists = {end: entry.get(end, []) for end in ("inputs", "outputs")}
    for end, quantities in lists.items():
        if not isinstance(quantities, list) or len(quantities) > MAX_QUANTITIES:
            raise ModelError(
                f"{place}: network '{role}' {end}", "is no short list", f"at most {MAX_QUANTITIES} quantities"
            )
    inputs, outputs = tuple(lists["inputs"]), tuple(lists["outputs"])
    _match(f"{place}: network '{role}' inputs", inputs, tuple(names for _, names, _ in forms), True)
    network = NetworkText(role, str(entry.get("input", "")), str(entry.get("output", "")), inputs, outputs)
    wanted = form_of(circuit, recipe, network)[2]
    _match(f"{place}: network '{role}' outputs", outputs, (wanted,), False)
    return network


def form_of(circuit: str, recipe: str, network: NetworkText) -> tuple[int, tuple[str, ...], tuple[str, ...]]:
    """(FORM_*, inputs, outputs) a network uses, names in the reduced model's order."""
    names = sorted(stem(quantity["name"]) for quantity in network.inputs)
    forms = ROLE_FORMS[circuit, recipe, network.role]
    return next(form for form in forms if sorted(form[1]) == names)


def _match(place: str, quantities: tuple[dict, ...], lists: tuple[tuple[str, ...], ...], ranged: bool) -> None:
    names = [stem(str(quantity.get("name", ""))) for quantity in quantities if isinstance(quantity, dict)]
    if len(names) != len(quantities) or sorted(names) not in [sorted(names_here) for names_here in lists]:
        known = " or ".join("(" + ", ".join(names_here) + ")" for names_here in lists)
        raise ModelError(place, f"({', '.join(names)})", known, "name each quantity once, with its unit last")
    for quantity in quantities:
        if not isinstance(quantity.get("unit"), str) or quantity["unit"] not in UNITS:
            raise ModelError(place, f"'{quantity['name']}' has unit {quantity.get('unit')!r}", ", ".join(UNITS))
        if ranged:
            low, high = quantity.get("low"), quantity.get("high")
            if not (_is_number(low) and _is_number(high) and low < high):
                raise ModelError(place, f"'{quantity['name']}' has training range {low!r} to {high!r}", "low < high")


def _is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST
