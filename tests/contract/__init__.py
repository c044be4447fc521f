"""What every transport keeps. A test body never names one: see `conftest.py`."""
