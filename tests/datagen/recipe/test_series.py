import pytest

from benchnav.datagen.recipe.scenario import find_series


@pytest.mark.parametrize(
    ("splits", "expected"),
    [
        (["test/std", "test/hg", "test/hs"], {}),
        (["test/hs-100"], {}),
        (["test/hs-100", "test/std"], {"test/hs": [(0.0, "test/std"), (1.0, "test/hs-100")]}),
        (["valid/std", "test/hs-100", "test/hs-025"],
         {"test/hs": [(0.25, "test/hs-025"), (1.0, "test/hs-100")]}),
        (["std", "dusk@0.5", "dusk@1.5", "hg-1000", "hg-10", "-050"],
         {"dusk": [(0.0, "std"), (0.5, "dusk@0.5"), (1.5, "dusk@1.5")]}),
        (["test/std", "test/hs-000", "test/hs-150"],
         {"test/hs": [(0.0, "test/hs-000"), (1.5, "test/hs-150")]}),
        (["test/std", "test/hg-050", "test/hg", "test/hs-050", "test/hs-100", "test/hs"],
         {"test/hg": [(0.0, "test/std"), (0.5, "test/hg-050"), (1.0, "test/hg")],
          "test/hs": [(0.0, "test/std"), (0.5, "test/hs-050"), (1.0, "test/hs-100")]}),
        (["test/std", "test/hg-050", "test/hs-050"],
         {"test/hg": [(0.0, "test/std"), (0.5, "test/hg-050")],
          "test/hs": [(0.0, "test/std"), (0.5, "test/hs-050")]}),
    ],
)  # fmt: skip
def test_series_are_read_from_the_names_of_splits(
    splits: list[str], expected: dict[str, list[tuple[float, str]]]
) -> None:
    assert find_series(splits) == expected
