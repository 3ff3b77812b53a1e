# Every verb makes .venv and installs what it needs first. Needs Python 3.11 or later, with its venv module, and make.
#   make test PYTHON=python3.12        another Python
#   make setup TORCH_BACKEND=auto      the CUDA build of torch instead of the CPU one
PYTHON        ?= python3
VENV          ?= .venv
TORCH_BACKEND ?=
# One process of tests more than there are cores: many tests wait for other processes.
JOBS          ?= $(shell $(PYTHON) -c 'import os; print(1 + (os.cpu_count() or 1))')

PY    := $(VENV)/bin/python
PIP   := $(PY) -m pip install -qq --disable-pip-version-check
STAMP := $(VENV)/.installed

# uv does not read pip's settings, so they are handed over: a directory of wheels may hold the CPU build of torch, and without
# it the default index answers with the CUDA one (19 packages more). uv refuses a directory that is missing, pip ignores it.
pip_setting = $(shell $(PY) -m pip config list 2>/dev/null | sed -n "s/^[^=]*\.$(1)='\(.*\)'$$/\1/p" | sed 's/\\n/ /g')
find_links  = $(sort $(foreach p,$(call pip_setting,find-links),$(if $(findstring ://,$p),$p,$(wildcard $p))))
index_url   = $(lastword $(call pip_setting,index-url))
uv_flags    = $(addprefix --default-index ,$(index_url)) \
              $(if $(TORCH_BACKEND),--torch-backend=$(TORCH_BACKEND),$(or $(addprefix --find-links ,$(find_links)),--torch-backend=cpu))

.PHONY: help setup demo lint quick check pytest test docs bench clean

help:
	@echo "make demo    a short pre-training from scratch: about five minutes, ends with what Bob has learned"
	@echo "make test    ruff, mypy and every test: about ten minutes, ends with how many passed"
	@echo "make setup   make $(VENV) and install everything into it: about two minutes, 2.9 GB; the others do it first"
	@echo "make check   ruff, mypy and the tests that are not slow: about a minute"
	@echo "make docs    the docs site, into build/docs-site/site"
	@echo "make bench   the throughput benchmarks, against panda-gym"
	@echo "make clean   remove $(VENV) and the caches; runs/ stays"
	@echo "Times are of two quiet cores. README.md says what to do first."

setup: $(STAMP)

$(VENV)/bin/uv:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "Python 3.11 or later is needed, got $$($(PYTHON) --version); try PYTHON=python3.11"; exit 1; }
	@echo "Installing into $(VENV) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) -c constraints.txt uv

# As a path, which type checkers follow, and not by a hook of Python's import, which they do not.
EDITABLE = -e '.[dev]' --config-settings editable_mode=compat

# uv takes seconds where pip takes a minute; pip is there for machines whose indexes only it knows. Bytecode is compiled here, as
# pip does: where Python may not write it later (PYTHONDONTWRITEBYTECODE), every process would take 2 s more to import torch.
$(STAMP): pyproject.toml constraints.txt | $(VENV)/bin/uv
	@$(VENV)/bin/uv pip install -q --compile-bytecode --python $(PY) $(uv_flags) -c constraints.txt $(EDITABLE) \
	  || { echo "uv could not install it; trying pip, which takes longer ..."; $(PIP) -c constraints.txt $(EDITABLE); }
	@touch $@

demo: $(STAMP)
	$(VENV)/bin/tandem demo
	@echo "  (tandem is $(VENV)/bin/tandem; after '. $(VENV)/bin/activate' it is just tandem)"

lint: $(STAMP)
	$(PY) -m ruff check
	$(PY) -m ruff format --check
	$(PY) -m mypy

# A file of tests stays in one process, so nothing that its tests share is made twice; tests/conftest.py puts the longest first.
# Many tests start other processes, which would compile what they import each time where Python may not write bytecode.
PYTEST = $(PY) -m compileall -q service && $(PY) -m pytest -n $(JOBS) --maxprocesses 8 --dist loadfile --no-loadscope-reorder

quick: $(STAMP)
	$(PYTEST) -m "not slow"

pytest: $(STAMP)
	$(PYTEST)

# Both at once: mypy takes a core for half a minute.
check: $(STAMP)
	@$(MAKE) -j 2 --no-print-directory lint quick

test: $(STAMP)
	@$(MAKE) -j 2 --no-print-directory lint pytest

docs: $(STAMP)
	$(PY) -m tools.docs_site
	@echo "  to read it:  $(PY) -m http.server --bind 127.0.0.1 --directory build/docs-site/site 8000"

$(VENV)/.bench-installed: $(STAMP)
	@$(PIP) -c constraints.txt -e '.[bench]'
	@touch $@

bench: $(VENV)/.bench-installed
	$(PY) -m benchmarks.env_throughput

clean:
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache build dist *.egg-info
	find service tests benchmarks tools -name __pycache__ -prune -exec rm -rf {} +
