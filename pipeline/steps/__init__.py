"""Steps of the pipeline (D3.2, section 4.2), one module each."""
