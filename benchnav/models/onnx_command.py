"""The command `benchnav-train export`: write a model for robots without PyTorch."""

from pathlib import Path


def export(
    checkpoint: str,
    onnx: str,
    level: float = 0.9,
    opset: int = 18,
    overwrite: bool = False,
) -> None:
    """Write a model as one ONNX graph: network, predicted parameters, mean and CVaR.

    Args:
        checkpoint: Folder of a checkpoint, its name, owner/name@revision of a hub, or
            path/to/file.py:Class@CHECKPOINT.
        onnx: Output file, FILE.onnx.
        level: Level of the CVaR, in [0, 1).
        opset: Version of ONNX's operators.
        overwrite: Replace an existing file.
    """
    from rich.filesize import decimal

    from benchnav.core.errors import expect
    from benchnav.models.onnx_graph import export_onnx
    from benchnav.models.predictor import load_model

    expect(onnx.endswith(".onnx"), f"`onnx` to end in .onnx, got {onnx!r}.")
    path = Path(onnx)
    expect(
        overwrite or not path.exists(),
        f"`onnx` to be a new file, got {onnx}, which exists. Pass --overwrite to "
        "replace it.",
    )
    graph = export_onnx(load_model(checkpoint), path, checkpoint, level, opset)
    size = decimal(path.stat().st_size)
    print(
        f"wrote {onnx} ({size}): from {', '.join(graph.input_names)} to "
        f"{', '.join(graph.output_names)} at level {level:g}"
    )
