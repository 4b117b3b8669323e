"""TensorBoard's event files, written by its own package: no framework is needed for them."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gacrl.config import files as configuration
from gacrl.config.run import RunConfig
from gacrl.training.recorder import RunFolder
from gacrl.training.trackers.sink import Row, Sink, closing, scalars

FOLDER = "tensorboard"


def begin(folder: RunFolder, config: RunConfig, name: str) -> Sink:
    """Write into `tensorboard/` of the run folder; `tensorboard --logdir runs` shows all runs side by side."""
    from PIL import Image
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.compat.proto.summary_pb2 import Summary, SummaryMetadata
    from tensorboard.compat.proto.tensor_pb2 import TensorProto
    from tensorboard.summary.writer.event_file_writer import EventFileWriter

    writer = EventFileWriter(str(folder.path / FOLDER))

    def write(values: list[Any], step: int) -> None:
        writer.add_event(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))
        writer.flush()

    def numbers(values: Mapping[str, float], step: int) -> None:
        write([Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()], step)

    def rows(evaluation: Sequence[Row]) -> None:
        numbers(scalars(evaluation), int(evaluation[0]["env_steps"]))

    def summary(content: Mapping[str, Any], step: int) -> None:
        numbers(closing(content), step)

    def picture(path: Path, step: int) -> None:
        with Image.open(path) as image:
            width, height = image.size
        shown = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=path.read_bytes())
        write([Summary.Value(tag="episodes", image=shown)], step)

    text = TensorProto(dtype=7, string_val=[f"```\n{configuration.dumps(config)}\n```".encode()])  # 7: strings
    about = SummaryMetadata(plugin_data=SummaryMetadata.PluginData(plugin_name="text"))
    write([Summary.Value(tag="settings", tensor=text, metadata=about)], 0)
    return Sink(rows, summary, picture, writer.close)
