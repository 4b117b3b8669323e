"""The policy as an ONNX graph, converted by jax2onnx from the traced program and checked with onnxruntime."""

import contextlib
import sys
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

from gacrl.errors import UserError
from gacrl.export.card import write_card
from gacrl.export.lean import lean
from gacrl.export.program import Program, flattened, program
from gacrl.export.recorded import Arrays, compared
from gacrl.export.source import Source
from gacrl.extras import require_extra
from gacrl.replacing import replaced

OPSET = 21
"""The version of ONNX's operators that the graph is of; it stands on the card."""


def write(source: Source, out: Path) -> Sequence[Path]:
    """Write the policy, its weights inside, and its card.

    Raises UserError where jax2onnx or onnxruntime is missing, or where jax2onnx cannot convert the network.
    """
    require_extra("onnx", "jax2onnx", "onnxruntime")
    it = program(source)
    data = convert(source, it)
    checked = compared(source, it, runner(data))
    card = write_card(source, it, out, f"{checked} Opset {OPSET}.")
    with replaced(out) as file:
        file.write(data)
    return [out, card]


def convert(source: Source, it: Program) -> bytes:
    """Return the program as a serialised ONNX model of opset 21, with as few operators as it needs.

    Raises UserError where jax2onnx cannot convert it.
    """
    return lean(traced(source, it))


def traced(source: Source, it: Program) -> bytes:
    """Return the program as jax2onnx makes it."""
    try:
        with _jax_as_it_is():
            from jax2onnx import to_onnx  # pyright: ignore[reportMissingImports]

            model = to_onnx(
                flattened(it),
                list(it.inputs.values()),
                model_name=f"gacrl {source.opened.config.task}",
                opset=OPSET,
                input_names=list(it.inputs),
                output_names=list(it.outputs),
            )
    except Exception as error:  # a dozen kinds, one for each primitive
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(f"jax2onnx cannot convert the policy of {source.name} ({why}): take stablehlo") from error
    return model.SerializeToString()


@contextlib.contextmanager
def _jax_as_it_is() -> Generator[None]:
    """Put back what jax2onnx puts in the place of JAX's public functions, and leaves there: `jnp.cumsum` for one."""
    public = [
        module for name, module in sys.modules.items() if name.split(".")[0] == "jax" and "._src" not in name
    ]
    before = [(module, name, it) for module in public for name, it in vars(module).items() if callable(it)]
    try:
        yield
    finally:
        for module, name, it in before:
            if vars(module).get(name) is not it:
                setattr(module, name, it)


def runner(data: bytes) -> Callable[[Arrays], Arrays]:
    """Return a function that runs the model on one core: inputs by name -> outputs by name."""
    import onnxruntime  # pyright: ignore[reportMissingImports]

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # it warns of every weight that it folds
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]

    def run(inputs: Arrays) -> Arrays:
        return dict(zip(names, session.run(names, inputs), strict=True))

    return run
