"""One row through a network of unknown making, in a process that may take 1 GB and a minute and no more.

The graph of a file can ask for any amount of memory and can loop for ever. What onnxruntime does inside the bench's own process
nobody can take back, so it does it here first: `python -m hilrunner.setup.model_probe`.
"""

import json
import resource
import signal
import subprocess
import sys

from hilrunner.base.errors import ModelError
from hilrunner.record import child

MEMORY_MAX_BYTES = 1 << 30
TIME_MAX_S = 60
_BUDGET = f"{MEMORY_MAX_BYTES >> 30} GB and {TIME_MAX_S} s"


def probe(
    place: str, role: str, part: bytes, shape: tuple[int, ...], single: bool, names: tuple[str, str]
) -> list[int]:
    """The shape of the answer to one row; ModelError with the reason where there is none within the budget.

    Args:
        part: an ONNX file. shape: of the feed. single: float32, else float64. names: of input and output.
    """
    asked = json.dumps({"shape": shape, "single": single, "names": names, "time_s": TIME_MAX_S}).encode() + b"\n"
    where = f"{place}: network '{role}'"
    try:
        done = subprocess.run(
            child.module_command("hilrunner.setup.model_probe"),
            input=asked + part,
            capture_output=True,
            timeout=TIME_MAX_S + 30,
            env=child.environment(),
        )
    except subprocess.TimeoutExpired:
        raise ModelError(where, "did not answer one row in time", _BUDGET, "a smaller network") from None
    if done.returncode < 0:
        reason = "took too long" if -done.returncode in (signal.SIGXCPU, signal.SIGKILL) else "ended onnxruntime"
        raise ModelError(where, f"{reason} over one row", _BUDGET, "a smaller network")
    try:
        answer = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        raise ModelError(where, "ended onnxruntime over one row", _BUDGET, "a smaller network") from None
    if "error" in answer:
        raise ModelError(
            where,
            f"onnxruntime cannot run one row of it: {answer['error']}",
            _BUDGET if answer["memory"] else "",
            "a smaller network" if answer["memory"] else "a model that answers one row at a time",
        )
    return answer["shape"]


def _answer(asked: dict, part: bytes) -> dict:
    import numpy as np
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    kind = np.float32 if asked["single"] else np.float64
    try:
        session = onnxruntime.InferenceSession(part, options, providers=["CPUExecutionProvider"])
        name, output = asked["names"]
        (made,) = session.run([output], {name: np.zeros(asked["shape"], kind)})
        return {"shape": list(np.shape(made))}
    except Exception as error:  # onnxruntime's error classes have no common base but Exception
        words = (str(error).strip() or type(error).__name__).splitlines()[0]
        memory = isinstance(error, MemoryError) or "alloc" in words.lower() or "memory" in words.lower()
        return {"error": words[:500], "memory": memory}


def main() -> int:
    """Read what is asked and the file from standard input, answer in one line of JSON."""
    asked = json.loads(sys.stdin.buffer.readline())
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_MAX_BYTES, MEMORY_MAX_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (asked["time_s"], asked["time_s"] + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    print(json.dumps(_answer(asked, sys.stdin.buffer.read())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
