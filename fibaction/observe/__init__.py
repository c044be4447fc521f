"""Views of what happens to goals: metrics, monitor, recordings and replay, traces, log records.

Each name is imported from its module when it is used first, since most programs need one of them.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fibaction.observe.action_listener import ActionListener, AnyClient
    from fibaction.observe.log_records import GoalFilter, JsonFormatter
    from fibaction.observe.metrics import CONTENT_TYPE, Metrics
    from fibaction.observe.metrics_server import serve_metrics
    from fibaction.observe.monitor import (
        ActionSnapshot,
        GoalKey,
        GoalSnapshot,
        Monitor,
        Snapshot,
        follow_action,
        follow_actions,
        newest_active_first,
    )
    from fibaction.observe.otel import Tracing
    from fibaction.observe.recordings.recorder import Recorder, record_from
    from fibaction.observe.recordings.recording_file import (
        Event,
        Record,
        RecordingError,
        export_mcap,
        payload_of,
        read_records,
    )
    from fibaction.observe.recordings.replay import replayed
else:
    from importlib import import_module

    _NAMES = {
        "action_listener": "ActionListener AnyClient",
        "log_records": "GoalFilter JsonFormatter",
        "metrics": "CONTENT_TYPE Metrics",
        "metrics_server": "serve_metrics",
        "monitor": (
            "ActionSnapshot GoalKey GoalSnapshot Monitor Snapshot follow_action follow_actions"
            " newest_active_first"
        ),
        "otel": "Tracing",
        "recordings.recorder": "Recorder record_from",
        "recordings.recording_file": (
            "Event Record RecordingError export_mcap payload_of read_records"
        ),
        "recordings.replay": "replayed",
    }
    _MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

    def __getattr__(name: str) -> object:
        """Import a name from its module when it is used first."""
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
        return value


__all__ = [
    "CONTENT_TYPE",
    "ActionListener",
    "ActionSnapshot",
    "AnyClient",
    "Event",
    "GoalFilter",
    "GoalKey",
    "GoalSnapshot",
    "JsonFormatter",
    "Metrics",
    "Monitor",
    "Record",
    "Recorder",
    "RecordingError",
    "Snapshot",
    "Tracing",
    "export_mcap",
    "follow_action",
    "follow_actions",
    "newest_active_first",
    "payload_of",
    "read_records",
    "record_from",
    "replayed",
    "serve_metrics",
]
