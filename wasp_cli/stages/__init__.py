"""One file per node kind: the only bridge between orchestration and science."""
