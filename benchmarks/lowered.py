"""The training programs of all presets as text, before any compiler has seen them: did a change change them?

    python benchmarks/lowered.py before              # writes before/PRESET.mlir
    python benchmarks/lowered.py after --against before

What is metadata only (names of results, where a line came from) is left out of the comparison. Prints for each preset
whether the text is the same, else how many instructions it had and has; fails where one grew by more than 2 %.
"""

import argparse
import re
import sys
from pathlib import Path

TOLERANCE = 0.02
LOWERED = "lowered instructions: "
"""What `guard.py` calls the counts of these."""


def lowered(preset: str) -> str:
    """The training chunk of a preset for one seed, as StableHLO text."""
    import jax
    import jax.numpy as jnp

    import gacrl
    from gacrl.training.build import make_trainer

    trainer = make_trainer(gacrl.preset(preset))
    state = jax.eval_shape(lambda: trainer.init_stacked((0,)))
    return trainer.chunk.lower(state, jax.ShapeDtypeStruct((), jnp.int32)).as_text()


def count(preset: str) -> int:
    """Instructions of that text."""
    return instructions(lowered(preset))


def without_metadata(text: str) -> str:
    """The same without names of results and places in the source."""
    return re.sub(r"jax\.result_info = \"[^\"]*\"|loc\([^)]*\)", "", text)


def instructions(text: str) -> int:
    """How many there are."""
    return text.count(" = ")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the texts go")
    parser.add_argument("--against", type=Path, help="a folder of texts to compare with")
    asked = parser.parse_args()
    import jax

    from gacrl.config.presets import PRESETS
    from gacrl.training.devices import prepare_jax

    jax.config.update("jax_num_cpu_devices", 2)
    prepare_jax()
    asked.folder.mkdir(parents=True, exist_ok=True)
    grown: list[str] = []
    for preset in PRESETS:
        text = lowered(preset)
        (asked.folder / f"{preset}.mlir").write_text(text, encoding="utf-8")
        if asked.against is None:
            print(f"{preset:14} {instructions(text):6} instructions")
            continue
        before = (asked.against / f"{preset}.mlir").read_text(encoding="utf-8")
        same = without_metadata(before) == without_metadata(text)
        print(
            f"{preset:14} {'the same' if same else f'{instructions(before)} -> {instructions(text)} instructions'}"
        )
        if instructions(text) > (1 + TOLERANCE) * instructions(before):
            grown.append(preset)
    if grown:
        sys.exit(f"grown by more than {TOLERANCE:.0%}: {', '.join(grown)}")


if __name__ == "__main__":
    main()
