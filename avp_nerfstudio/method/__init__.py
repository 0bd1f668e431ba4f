"""The method `avp-nerfacto`: configuration, model, training and scores."""
