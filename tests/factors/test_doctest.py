import doctest

from optshape_graph import factors


def test_the_example_in_the_docstring_runs():
    results = doctest.testmod(factors)
    assert results.attempted > 10
    assert results.failed == 0
