"""One page to send: a run's report as HTML, with the scene to fly through."""
