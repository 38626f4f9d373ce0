"""The steps of the method: pure functions `(Inputs, Config, observe) -> Output`."""
