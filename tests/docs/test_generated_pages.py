"""Pages and pictures that a script writes are up to date."""

import packages_picture
from blind_residual import rounds


def test_the_picture_of_the_packages_shows_today_s_imports():
    assert packages_picture.PICTURE.read_text("utf-8") == packages_picture.render(), (
        "run python scripts/packages_picture.py"
    )


def test_no_dot_of_the_picture_leads_upwards():
    packages = packages_picture.floors()
    for k, package in enumerate(packages):
        assert packages_picture.imported_packages(package) & set(packages) <= set(packages[k + 1 :])


def test_the_page_of_the_sealed_rounds_has_the_numbers_of_their_documents():
    assert rounds.PAGE.read_text("utf-8") == rounds.render(), "run python -m blind_residual.rounds"
