"""Puts the shipped maps and models into wheels and source archives; all else is said in
pyproject.toml.

They stay where they are in the repository, and the wheel holds them under
`benchnav/_shipped`. Only the files named here go in, whatever else lies in those
folders. The checkpoint paper-v1, 29 MB of weights, stays out, of source archives too.
"""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

INSIDE = Path("benchnav", "_shipped")
SHIPPED = (
    "datasets/README.md",
    "datasets/paper-v1-test.h5",
    "datasets/paper-v1-test.md",
    "datasets/stakes-v1-test.h5",
    "datasets/stakes-v1-test.md",
    "checkpoints/README.md",
    "checkpoints/stakes-v1/README.md",
    "checkpoints/stakes-v1/classifier.safetensors",
    "checkpoints/stakes-v1/config.json",
    "checkpoints/stakes-v1/gp.safetensors",
    "checkpoints/stakes-v1/ground.json",
    "checkpoints/stakes-v1-masked/README.md",
    "checkpoints/stakes-v1-masked/classifier.safetensors",
    "checkpoints/stakes-v1-masked/config.json",
    "checkpoints/stakes-v1-masked/gp.safetensors",
    "checkpoints/stakes-v1-masked/ground.json",
)


class BuildWithShipped(build_py):
    """Copies the shipped files beside the modules; an editable installation reads them
    where they are.
    """

    def run(self) -> None:
        """Builds the modules, then adds the files."""
        super().run()
        if not self.editable_mode:
            for name, target in self._targets().items():
                self.mkpath(str(Path(target).parent))
                self.copy_file(name, target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        """What is built, for the list of installed files."""
        added = [] if self.editable_mode else list(self._targets().values())
        return [*super().get_outputs(include_bytecode), *added]

    def get_source_files(self) -> list[str]:
        """What a source archive has to hold."""
        return [*super().get_source_files(), *SHIPPED]

    def _targets(self) -> dict[str, str]:
        return {name: str(Path(self.build_lib) / INSIDE / name) for name in SHIPPED}


if __name__ == "__main__":
    setup(cmdclass={"build_py": BuildWithShipped})
