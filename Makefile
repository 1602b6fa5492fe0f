# `make demo` sets up and runs the main job; `make test` sets up and passes every test.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test setup system bench lint

setup: $(VENV)/.installed

# System libraries, from Debian's or Ubuntu's own packages: Python's venv module, and what Open3D loads.
SYSTEM_PACKAGES := python3-venv libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1
