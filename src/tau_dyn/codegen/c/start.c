static const double home[NA + NZ] = {@HOME@};

void @NAME@_start(double start[NA + NZ])
{
    for (int k = 0; k < NA + NZ; ++k) start[k] = home[k];
}
