"""Learn 6-DoF pose detectors from unlabelled images by analysis-by-synthesis with curiosity."""
