"""Make a surrogate: sample the plant, train, test, export ONNX with a data sheet. Needs the extra `train` (torch)."""

import argparse
import sys

from hilrunner.commands import options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner train`."""
    parser.add_argument("--profile", default="amc-lift", metavar="NAME|FILE", help="whose plant (default: %(default)s)")
    parser.add_argument("--axis", default=None, metavar="NAME", help="axis of the profile (default: the first)")
    parser.add_argument("--recipe", choices=("flow", "paper"), default="flow", help="default: %(default)s")
    parser.add_argument("--out", default="trained", metavar="DIR", help="folder for everything (default: %(default)s)")
    parser.add_argument("--layers", default="25,10,20", help="tanh layers (default: %(default)s)")
    parser.add_argument(
        "--points", type=int, default=20_000, metavar="N", help="training points (default: %(default)s)"
    )
    parser.add_argument("--validation-points", type=int, default=20_000, metavar="N", help="default: %(default)s")
    parser.add_argument("--test-points", type=int, default=100_000, metavar="N", help="default: %(default)s")
    parser.add_argument(
        "--stages",
        default=None,
        metavar="N:I,...",
        help="points and iterations of each stage (default: 1500:300,6000:120,20000:30)",
    )
    parser.add_argument("--article", action="store_true", help="the article's 2e7 / 2.5e6 / 2.5e6 points (hours)")
    parser.add_argument(
        "--seed", type=options.whole(0, 2**32 - 1), default=1, help="of samples and weights (default: %(default)s)"
    )
    parser.add_argument(
        "--seconds",
        type=options.seconds,
        default=None,
        help="time limit a network; makes the result depend on the clock",
    )
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoints in --out")
    parser.add_argument(
        "--rivals", action="store_true", help="train with Adam and L-BFGS for the same time, to compare"
    )
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="default: %(default)s")
    parser.add_argument("--json", action="store_true", help="the data sheet on stdout")


def main(args: argparse.Namespace) -> int:
    """Train and export; prints the path of the model."""
    import json
    import time
    from dataclasses import replace
    from pathlib import Path

    from hilrunner.base import status
    from hilrunner.base.errors import UsageError
    from hilrunner.commands.targets import check_folder
    from hilrunner.setup.profile import load_profile

    try:
        import torch
    except ImportError as error:
        raise UsageError(
            "hilrunner train", "torch is not installed", remedy="pip install 'hilrunner[train]'"
        ) from error

    from hilrunner.plant.parameters import make_parameters
    from hilrunner.training.curves import save
    from hilrunner.training.publish import write_model
    from hilrunner.training.recipes import make_recipe
    from hilrunner.training.train import train_recipe

    loaded = load_profile(args.profile)
    axis = _axis(loaded, args.axis)
    parameters = make_parameters(axis.preset, axis.parameters)
    recipe = make_recipe(status.CIRCUIT_NAMES.index(axis.circuit), args.recipe, parameters)
    layers = _numbers(args.layers, "--layers")
    recipe = replace(recipe, problems=tuple(replace(problem, layers=layers) for problem in recipe.problems))
    device = args.device if args.device != "auto" else ("cuda" if torch.cuda.is_available() else "cpu")
    plan = _plan(args, device)
    folder = Path(args.out)
    check_folder(folder)
    started = time.monotonic()
    outcomes = train_recipe(recipe.problems, plan, folder, args.resume, _progress_printer(args.json))
    command = _command(args, plan)
    profile = {
        "name": loaded.profile.name,
        "axis": axis.name,
        "preset": axis.preset,
        "overrides": dict(axis.parameters),
    }
    path = write_model(recipe, outcomes, plan, folder, command, profile)
    save({outcome.facts["role"]: outcome.curves for outcome in outcomes}, path.with_suffix(".curves.png"))
    rivals = _rivals(args, recipe, plan, folder, outcomes)
    sheet = json.loads(path.with_name(path.name + ".json").read_text("utf-8"))
    if args.json:
        print(json.dumps(sheet | {"path": str(path), "wall_s": time.monotonic() - started, "rivals": rivals}))
    else:
        _print_outcomes(path, sheet, time.monotonic() - started, rivals)
    return 0


def _command(args: argparse.Namespace, plan) -> str:
    """What makes the same networks again."""
    stages = ",".join(f"{stage.points}:{stage.iterations}" for stage in plan.stages)
    words = ["hilrunner train", f"--profile {args.profile}", f"--recipe {args.recipe}", f"--layers {args.layers}"]
    words += [f"--axis {args.axis}"] if args.axis else []
    words += [f"--points {plan.train_points}", f"--validation-points {plan.validation_points}"]
    words += [f"--test-points {plan.test_points}", f"--stages {stages}", f"--seed {plan.seed}"]
    return " ".join(words)


def _axis(loaded, name: str | None):
    from hilrunner.base.errors import UsageError

    axes = loaded.profile.axis
    if name is None:
        return axes[0]
    for axis in axes:
        if axis.name == name:
            return axis
    raise UsageError("--axis", f"'{name}' is not in the profile", ", ".join(axis.name for axis in axes))


def _numbers(text: str, place: str) -> tuple[int, ...]:
    from hilrunner.base.errors import UsageError

    try:
        numbers = tuple(int(word) for word in text.split(","))
    except ValueError as error:
        raise UsageError(place, f"'{text}'", "whole numbers with commas") from error
    if not numbers or min(numbers) < 1 or max(numbers) > 512 or len(numbers) > 7:
        raise UsageError(place, f"'{text}'", "1 to 7 numbers of 1 to 512")
    return numbers


def _plan(args: argparse.Namespace, device: str):
    from hilrunner.base.errors import UsageError
    from hilrunner.training.train import STAGES, Plan, Stage

    sizes = (
        (20_000_000, 2_500_000, 2_500_000) if args.article else (args.points, args.validation_points, args.test_points)
    )
    if min(sizes) < 1:
        raise UsageError("--points", f"{min(sizes)}", "at least 1")
    stages = STAGES
    if args.stages is not None:
        try:
            pairs = [word.split(":") for word in args.stages.split(",")]
            stages = tuple(Stage(int(points), int(iterations)) for points, iterations in pairs)
        except ValueError as error:
            raise UsageError("--stages", f"'{args.stages}'", "points:iterations,...") from error
    elif args.article:
        stages = (*STAGES, Stage(sizes[0], 10))
    stages = tuple(Stage(min(stage.points, sizes[0]), stage.iterations) for stage in stages)
    seconds = float("inf") if args.seconds is None else args.seconds
    return Plan(sizes[0], sizes[1], sizes[2], stages, args.seed, seconds=seconds, device=device)


def _progress_printer(quiet: bool):
    """A line a network now and then on stderr."""
    import threading
    import time

    last: dict[str, float] = {}
    lock = threading.Lock()

    def report(role: str, what: str, share: float) -> None:
        now = time.monotonic()
        with lock:
            if quiet or (now - last.get(role, 0.0) < 5.0 and share < 1.0):
                return
            last[role] = now
            print(f"{role:10s} {100 * share:5.1f} %  {what}", file=sys.stderr, flush=True)

    return report


def _rivals(args: argparse.Namespace, recipe, plan, folder, outcomes) -> list[dict]:
    if not args.rivals:
        return []
    from hilrunner.training.rivals import compare

    return [
        row
        for problem, outcome in zip(recipe.problems, outcomes, strict=True)
        for row in compare(problem, plan, folder, outcome.facts["training_s"])
    ]


def _print_outcomes(path, sheet: dict, wall_s: float, rivals: list[dict]) -> None:
    print(f"{path}  ({wall_s:.0f} s, sha256 {sheet['sha256'][:12]})")
    for facts in sheet["networks"]:
        test = facts["test"]
        print(
            f"  {facts['role']}: {facts['parameters']} parameters ({facts['effective_parameters']:.0f} effective), "
            f"{facts['iterations']} iterations in {facts['training_s']:.0f} s, {facts['unsolved_points']} points unsolved"
        )
        for quantity, rms, largest in zip(facts["outputs"], test["rms"], test["largest"], strict=True):
            print(f"    {quantity['name']}: test RMS {rms:.3g} {quantity['unit']}, largest {largest:.3g}")
        print(
            f"    normalised mean square error {test['normalised_mean_square']:.2e}; "
            f"the best constant reaches {test['constant_predictor_normalised_mean_square']:.2e}"
        )
    for row in rivals:
        print(
            f"  {row['role']} by {row['method']}: normalised mean square error {row['normalised_mean_square']:.2e} in {row['seconds']:.0f} s"
        )
