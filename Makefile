# make demo   install into .venv and run one full truck shift over CAN
# make test   install into .venv and run the tests (needs no root, no CAN hardware)
# make lint   ruff (rules and format), mypy and the import rules
# make docs   build the documentation site in build/site
# make gallery  make the pictures of the documentation again (minutes)
# make bench  measurements side by side (minutes): python -m tests.bench
# make coverage lines and branches of controller/ and can_dbc/ that no test reaches: none may be left
# make mutants  mutation testing of both: some 5,300 mutants, 23 min of processor time; mutmut is installed for it
# make golden say what the firmware does differently, and record the golden replays anew
PYTHON ?= python3
VENV   ?= .venv
PY     := $(VENV)/bin/python
MARK   ?= not slow and not vcan and not browser
JOBS   ?= auto
DEMO   ?= runs/demo

.PHONY: demo test slow lint docs gallery bench coverage mutants golden clean
.DELETE_ON_ERROR:

# One stamp per set of extras; an edited requirement installs again, edited source does not.
define install
	@test -x $(PY) || $(PYTHON) -m venv $(VENV) || { \
	    echo "make: no virtual environment; on Debian: apt-get install python3-venv" >&2; exit 1; }
	@echo "installing into $(VENV) ..."
	@if command -v uv >/dev/null 2>&1; then \
	    uv pip install --quiet --python $(PY) -c constraints.txt -e '$(1)'; \
	else \
	    $(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '$(1)'; \
	fi
	@touch $@
endef

$(VENV)/.run: pyproject.toml constraints.txt
	$(call install,.[live])

$(VENV)/.dev: pyproject.toml constraints.txt
	$(call install,.[dev])
	@touch $(VENV)/.run

demo: $(VENV)/.run
	@$(VENV)/bin/opc4 run full_shift --transport local --out $(DEMO) --force
	@echo "picture: $(DEMO)/shift.png   page: $(DEMO)/report.html"

test: $(VENV)/.dev
	$(PY) -m pytest -m "$(MARK)" -n $(JOBS) --maxprocesses 4 --dist worksteal tests

slow: $(VENV)/.dev
	$(PY) -m pytest -m "slow and not vcan and not browser" -n $(JOBS) --maxprocesses 4 --dist worksteal tests

lint: $(VENV)/.dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

docs: $(VENV)/.dev
	$(PY) -m docs.generate
	$(PY) -m sphinx -q -W --keep-going -d build/doctrees docs build/site
	@echo "site: build/site/index.html"

gallery: $(VENV)/.run
	PYTHONPATH=. $(PY) docs/make_gallery.py

bench: $(VENV)/.dev
	$(PY) -m tests.bench

COVERING := tests/unit/can_dbc tests/unit/controller tests/contracts/test_codec.py tests/contracts/test_e2e.py \
            tests/contracts/test_firmware_contract.py

coverage: $(VENV)/.dev
	$(PY) -m coverage run -m pytest -q -m "not slow" --hypothesis-profile=few $(COVERING)
	$(PY) -m coverage report

mutants: $(VENV)/.dev
	$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[mutation]'
	$(PY) -m tests.mutation

golden: $(VENV)/.dev
	$(PY) -m tests.golden_replays tests/golden --update

clean:
	rm -rf runs build mutants .coverage *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
