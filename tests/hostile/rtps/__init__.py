"""Attacks on a participant of RTPS, beside an honest pair."""
