# The habits of this repository. `make check` is what .ci/run checks, in the present environment.
PYTHON ?= python

.PHONY: check lint types layers test images

check: lint types layers test

lint:
	$(PYTHON) -m ruff check .

types:
	$(PYTHON) -m pyright

layers:
	lint-imports

test:
	$(PYTHON) -m pytest

images:
	$(PYTHON) docs/make_images.py
