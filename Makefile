# Two commands for a fresh machine with Python >= 3.11 and make: `make train` and `make test`.

PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: train test slow soak cluster plain-path lint types docs bench bench-short release lock clean

train: $(STAMP)  ## the default preset: where its summary and GIF lie is printed at the end
	"$(BIN)/gacrl" train

test: $(STAMP)
	"$(BIN)/python" -m pytest -n 2 --dist loadgroup --no-loadscope-reorder

slow: $(STAMP)  ## what CI runs besides
	"$(BIN)/python" -m pytest -n 2 --dist loadgroup --no-loadscope-reorder -m slow

soak: $(STAMP)  ## what is too slow for every change
	"$(BIN)/python" -m pytest -m soak

plain-path:
	@case "$(CURDIR)" in *" "*) \
	  echo "Ray cannot start its workers from $(CURDIR): clone into a folder whose path has no space" >&2; exit 2;; esac

cluster: plain-path $(STAMP)  ## searches on a Ray cluster of two nodes, on this machine
	"$(BIN)/python" -m pip install --quiet --disable-pip-version-check --editable ".[dev,ray]"
	"$(BIN)/python" -m pytest -m cluster

lint: $(STAMP)
	"$(BIN)/ruff" check .
	"$(BIN)/ruff" format --check .

types: $(STAMP)
	"$(BIN)/pyright"

docs: $(STAMP)  ## the site, in build/site/html; what commands print there is run again where the program changed
	"$(BIN)/python" -m pip install --quiet --disable-pip-version-check -c constraints.txt --editable ".[dev,docs]"
	"$(BIN)/python" docs/site/stage.py build/site
	rm -rf build/site/html
	"$(BIN)/python" -m sphinx --fail-on-warning --keep-going --quiet build/site/source build/site/html
	@echo "the site: build/site/html/index.html"

bench: $(STAMP)  ## side by side with peers, in environments of their own; fails where a ratio has fallen
	"$(BIN)/python" benchmarks/guard.py
	"$(BIN)/python" benchmarks/paper_schedule.py

bench-short: $(STAMP)  ## compiled programs have not grown
	"$(BIN)/python" benchmarks/guard.py --short

release:  ## wheel and sdist, each tried in a fresh environment from another folder; missing Pythons are skipped
	"$(PYTHON)" .ci/release.py $(LEGS)

lock:  ## pin what CI installs anew: the newest of everything that pyproject.toml allows
	"$(PYTHON)" -m venv .venv-lock
	.venv-lock/bin/python -m pip install --quiet --disable-pip-version-check ".[dev,docs]"
	{ echo "# What CI installs; made by \`make lock\`. Nightly builds are left out: registries drop them."; \
	  .venv-lock/bin/python -m pip freeze --exclude gacrl | grep -v nightly; } > constraints.txt
	rm -rf .venv-lock

$(STAMP): pyproject.toml constraints.txt
	"$(PYTHON)" -c 'import sys; sys.exit("gacrl needs Python 3.11 or newer, this is " + sys.version.split()[0] + ": make PYTHON=python3.12" if sys.version_info < (3, 11) else 0)'
	"$(PYTHON)" -m venv .venv
	"$(BIN)/python" -m pip install --quiet --disable-pip-version-check -c constraints.txt --editable ".[dev]"
	touch "$@"

clean:
	rm -rf .venv
