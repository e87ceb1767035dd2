# The habits of this repository. `make check` is what .ci/run checks, in the present environment.
PYTHON ?= python

.PHONY: check lint types layers test bench images

check: lint types layers test bench

lint:
	$(PYTHON) -m ruff check .

types:
	$(PYTHON) -m pyright

layers:
	lint-imports

test:
	$(PYTHON) -m pytest

bench:
	$(PYTHON) -m benchmarks --quick --gate

images:
	$(PYTHON) docs/make_images.py
