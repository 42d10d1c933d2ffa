"""The loop, growth, schedule and decisions; `methods` holds what can be trained."""
