"""The only room that knows torch: sampling, dataset, Levenberg-Marquardt with Bayesian regularisation, export."""
