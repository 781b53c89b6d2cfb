/* SPDX-License-Identifier: Apache-2.0
 *
 * Runs an FMU (FMI 3.0) of this project on Windows: HOST DLL TOKEN STEP SAMPLES INPUTS OUTPUTS
 *
 * INPUTS and OUTPUTS have a letter for each variable, from the reference 1 on: d for a Float64, u for a UInt8; x
 * alone for none. The file given has the inputs and found gets the outputs, sample by sample, as doubles.
 */
#include "fmi3FunctionTypes.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <windows.h>

#define FUNCTION(name) name##TYPE *name = (name##TYPE *)(void *)GetProcAddress(library, #name)

int main(int count, char **words)
{
    HMODULE library = count == 7 ? LoadLibraryA(words[1]) : NULL;
    if (!library)
        return 2;
    FUNCTION(fmi3InstantiateCoSimulation);
    FUNCTION(fmi3EnterInitializationMode);
    FUNCTION(fmi3ExitInitializationMode);
    FUNCTION(fmi3SetFloat64);
    FUNCTION(fmi3SetUInt8);
    FUNCTION(fmi3GetFloat64);
    FUNCTION(fmi3GetUInt8);
    FUNCTION(fmi3DoStep);
    fmi3Instance unit = fmi3InstantiateCoSimulation("unit", words[2], "", 0, 0, 0, 0, NULL, 0, NULL, NULL, NULL);
    if (!unit || fmi3EnterInitializationMode(unit, 0, 0.0, 0.0, 0, 0.0) || fmi3ExitInitializationMode(unit))
        return 3;
    FILE *given = fopen("given", "rb"), *found = fopen("found", "wb");
    double step = atof(words[3]), value, reached;
    fmi3Boolean event, end, early;
    for (long sample = 0; sample < atol(words[4]); sample++) {
        fmi3ValueReference place = 1;
        for (const char *kind = words[5]; *kind != 'x' && *kind; kind++, place++) {
            if (fread(&value, sizeof value, 1, given) != 1)
                return 7;
            fmi3UInt8 octet = (fmi3UInt8)value;
            if (*kind == 'd' ? fmi3SetFloat64(unit, &place, 1, &value, 1) : fmi3SetUInt8(unit, &place, 1, &octet, 1))
                return 4;
        }
        if (fmi3DoStep(unit, (double)sample * step, step, 1, &event, &end, &early, &reached))
            return 5;
        for (const char *kind = words[6]; *kind; kind++, place++) {
            fmi3UInt8 octet = 0;
            if (*kind == 'd' ? fmi3GetFloat64(unit, &place, 1, &value, 1) : fmi3GetUInt8(unit, &place, 1, &octet, 1))
                return 6;
            value = *kind == 'd' ? value : (double)octet;
            fwrite(&value, sizeof value, 1, found);
        }
    }
    return fclose(found);
}
