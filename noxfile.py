"""Tasks: `nox` runs the default ones, `nox -s NAME -- ARGUMENTS` one; each has an environment of its own.

lint, types, docs, tests: what the workflow runs. pages: the tutorials, executed. words: measures of names and prose. build: sdist
and wheel. campaigns: all long studies.
"""

import nox

nox.options.sessions = ["lint", "types", "docs", "tests"]
nox.options.reuse_existing_virtualenvs = True
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@nox.session
def lint(session: nox.Session) -> None:
    """Check and format with ruff; `-- --fix` repairs."""
    session.install("ruff>=0.15")
    session.run("ruff", "check", *session.posargs, ".")
    session.run("ruff", "format", *([] if session.posargs else ["--check"]), ".")


@nox.session
def types(session: nox.Session) -> None:
    """Check types with pyright."""
    session.install(".[test,dev]")
    session.run("pyright", "--pythonpath", f"{session.bin}/python")


@nox.session
def docs(session: nox.Session) -> None:
    """Build the site into site/; `-- serve` shows it while you write."""
    session.install("-e", ".[docs]")
    arguments = session.posargs or ["build", "--strict"]
    session.run("mkdocs", *arguments, env={"NO_MKDOCS_2_WARNING": "1"})


@nox.session
def tests(session: nox.Session) -> None:
    """Run the fast tests, all or those named."""
    session.install("-e", ".[test]")
    session.run("pytest", *session.posargs, env=ONE_THREAD)


@nox.session
def tests_all(session: nox.Session) -> None:
    """Run all tests, the long ones too."""
    session.install("-e", ".[test]")
    session.run("pytest", "-m", "not slow", *session.posargs, env=ONE_THREAD)


@nox.session
def pages(session: nox.Session) -> None:
    """Execute the tutorials, the slow ones too, and compare with what they show."""
    session.install("-e", ".[test,docs]")
    session.run("pytest", "-m", "slow or not slow", "tests/docs", *session.posargs, env=ONE_THREAD)


@nox.session
def words(session: nox.Session) -> None:
    """Measure names and prose against their goals."""
    session.run("python", "experiments/vocabulary.py", *session.posargs)


@nox.session
def build(session: nox.Session) -> None:
    """Build sdist and wheel into dist/."""
    session.install("build")
    session.run("python", "-m", "build")


@nox.session
def campaigns(session: nox.Session) -> None:
    """Run all long studies; what is done is passed over."""
    session.install("-e", ".[test,experiments]")
    session.run("python", "experiments/campaigns.py", *(session.posargs or ["--jobs", "2", "--out", "out/campaigns"]))
