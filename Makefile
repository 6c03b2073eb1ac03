# make demo   simulate a roadheader, smooth and filter its log, compare with the truth
# make test   lint and tests
# make picture   docs/report.png, the top of the demo's report; needs Chromium
# Everything runs in $(VENV), made on first use from the pinned versions in constraints.txt.

VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
CHROMIUM ?= chromium

# The first Python that is new enough; looked for only when the environment has to be made.
NEW_ENOUGH := import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(firstword $(foreach p,python3.11 python3 python3.12 python3.13,\
	$(shell $(p) -c '$(NEW_ENOUGH)' 2>/dev/null && echo $(p))))

.PHONY: demo picture test lint format clean

demo: $(READY)
	@mkdir -p demo
	$(BIN)/python -m datasets make tbm-drive -o demo/tbm-drive.mcap --duration 120
	$(BIN)/tbmfg compare demo/tbm-drive.mcap --estimators batch,ins --truth auto -o demo/result --force
	@echo "open demo/result/report.html; the smoothed trajectory is in demo/result/batch"

picture: demo
	$(CHROMIUM) --headless=new --no-sandbox --disable-gpu --hide-scrollbars --window-size=1120,1640 \
		--virtual-time-budget=20000 --screenshot=docs/report.png "file://$(CURDIR)/demo/result/report.html"

test: lint
	$(BIN)/python -m pytest -n 2

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) demo dist build .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV): $(READY)

$(READY): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "tbmfg needs Python 3.11 or newer with its venv module" \
		"(on Debian and Ubuntu: the packages python3.11 and python3.11-venv)" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@touch $@
