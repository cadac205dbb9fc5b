"""The command `benchnav-train export`: a checkpoint as a file for robots that have no
PyTorch.
"""

from pathlib import Path


def export(
    checkpoint: str,
    onnx: str,
    level: float = 0.9,
    opset: int = 18,
    overwrite: bool = False,
) -> None:
    """Write a model as one ONNX graph: its network, the parameters of what it predicts,
    mean and CVaR.

    Args:
        checkpoint: Folder of a checkpoint, its name, owner/name@revision of a hub, or
            path/to/file.py:Class@CHECKPOINT.
        onnx: File to write, FILE.onnx.
        level: Level of the CVaR, in [0, 1).
        opset: Version of ONNX's operators.
        overwrite: Replace a file that is there.
    """
    from rich.filesize import decimal

    from benchnav.core.errors import expect
    from benchnav.models.onnx_graph import export_onnx
    from benchnav.models.predictor import load_model

    expect(onnx.endswith(".onnx"), f"`onnx` as a file FILE.onnx, got {onnx!r}.")
    path = Path(onnx)
    expect(
        overwrite or not path.exists(),
        f"`onnx` as a new file, got {onnx}, which exists. Pass --overwrite to replace "
        "it.",
    )
    graph = export_onnx(load_model(checkpoint), path, checkpoint, level, opset)
    print(
        f"wrote {onnx} ({decimal(Path(path).stat().st_size)}): from "
        f"{', '.join(graph.layers)} "
        f"to {', '.join(graph.names)} at level {level:g}"
    )
