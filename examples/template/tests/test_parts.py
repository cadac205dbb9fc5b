"""Both parts keep their contracts, under the names that pyproject.toml gives them."""

from benchnav.testing import check_model, check_planner


def test_the_planner_keeps_its_contract():
    check_planner("rays", robots=["unicycle"])


def test_the_model_keeps_its_contract():
    check_model("slope")
