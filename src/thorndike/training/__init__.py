"""One runner for every algorithm, the sources it draws on, and the directory a run is kept in. It knows no algorithm by name."""
